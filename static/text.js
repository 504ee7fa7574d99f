// Numbers and names as people read them.
import { t } from './words.js';

/** Bytes, as 3.1 MB. */
export function formatBytes(bytes) {
  if (bytes < 1000) return `${bytes} B`;
  const units = ['kB', 'MB', 'GB'];
  let value = bytes / 1000;
  let unit = 0;
  while (value >= 999.5 && unit < units.length - 1) {
    value /= 1000;
    unit++;
  }
  return `${value < 9.95 ? value.toFixed(1) : Math.round(value)} ${units[unit]}`;
}

/** A message as a sentence of its own. */
export function sentence(message) {
  return message.charAt(0).toUpperCase() + message.slice(1);
}

const STAGES = {
  photo: 'Reading the photo',
  depth: 'Estimating depth',
  denoise: 'Cleaning the depth',
  snap: 'Sharpening depth edges',
  planes: 'Placing planes',
  layers: 'Building layers',
  refine: 'Refining layers',
  prune: 'Leaving out what is never seen',
  encode: 'Packing',
  verify: 'Checking the result',
};

/** A stage of the way in a person's words. */
export function stageText(stage) {
  return t(STAGES[stage] ?? stage);
}

/** A place in the queue in a person's words. */
export function queueText(position) {
  return position > 0 ? t('Waiting for its turn, {0} before it', position) : t('Waiting for its turn');
}

const NAME_KEY = 'tmpi:name:';

/** The name of the file that a photo came from is known only to the browser that sent it. */
export function rememberName(id, name) {
  try {
    localStorage.setItem(NAME_KEY + id, name);
  } catch {
    // storage is full or forbidden: the date has to do
  }
}

export function forgetName(id) {
  try {
    localStorage.removeItem(NAME_KEY + id);
  } catch {
    // as above
  }
}

/** What to call a photo: its title, its file's name without the ending, or when it was made. */
export function photoName(photo) {
  if (photo.settings?.title) return photo.settings.title;
  let name = null;
  try {
    name = localStorage.getItem(NAME_KEY + photo.id);
  } catch {
    // as above
  }
  if (name) return name.replace(/\.[a-z0-9]{2,5}$/i, '');
  const date = new Date(photo.created);
  if (Number.isNaN(date.getTime())) return t('Photo');
  const year = date.getFullYear() === new Date().getFullYear() ? undefined : 'numeric';
  return date.toLocaleString(undefined, { year, month: 'short', day: 'numeric', hour: 'numeric', minute: '2-digit' });
}

/** An element with a class and text or children. */
export function element(tag, className, ...content) {
  const out = document.createElement(tag);
  if (className) out.className = className;
  out.append(...content);
  return out;
}

/** An icon of icons.svg. */
export function icon(name) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  const use = document.createElementNS('http://www.w3.org/2000/svg', 'use');
  use.setAttribute('href', `/static/icons.svg#${name}`);
  svg.setAttribute('aria-hidden', 'true');
  svg.append(use);
  return svg;
}
