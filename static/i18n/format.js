// Numbers and names as people read them.
import { german } from './element.js';
import { t } from './messages.js';

/**
 * A number with so many decimals, in the page's language.
 * @param {number} value
 * @param {number} digits
 */
export function decimal(value, digits) {
  const text = value.toFixed(digits);
  return german ? text.replace('.', ',') : text;
}

/**
 * Bytes, as 3.1 MB.
 * @param {number} bytes
 */
export function formatBytes(bytes) {
  if (bytes < 1000) return `${bytes} B`;
  const units = ['kB', 'MB', 'GB'];
  let value = bytes / 1000;
  let unit = 0;
  while (value >= 999.5 && unit < units.length - 1) {
    value /= 1000;
    unit++;
  }
  return `${value < 9.95 ? decimal(value, 1) : Math.round(value)} ${units[unit]}`;
}

/**
 * A time of day on a day.
 * @param {number} seconds since 1970
 */
export function moment(seconds) {
  return new Date(seconds * 1000).toLocaleString(undefined, { dateStyle: 'medium', timeStyle: 'short' });
}

/**
 * A message as a sentence of its own.
 * @param {string} message
 */
export function sentence(message) {
  return message.charAt(0).toUpperCase() + message.slice(1);
}

/** @type {Record<string, string>} */
const STAGES = {
  photo: 'Reading the photo',
  depth: 'Estimating depth',
  denoise: 'Cleaning the depth',
  strokes: 'Touching up the depth',
  snap: 'Sharpening depth edges',
  planes: 'Placing planes',
  layers: 'Building layers',
  refine: 'Refining layers',
  prune: 'Leaving out what is never seen',
  encode: 'Packing',
  verify: 'Checking the result',
};

/**
 * A stage of the way in a person's words.
 * @param {string} stage
 */
export function stageText(stage) {
  return t(STAGES[stage] ?? stage);
}

/**
 * A place in the queue in a person's words.
 * @param {number} position
 */
export function queueText(position) {
  return position > 0 ? t('Waiting for its turn, {0} ahead', position) : t('Waiting for its turn');
}
