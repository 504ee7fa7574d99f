// Chromium for the tests, with WebGPU on a software rasteriser; TMPI_WEBGPU=native takes the machine's GPU. All files share the one that
// run.mjs has started; a file that runs by itself starts its own.
import { existsSync, readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { chromium } from 'playwright-core';
import { PATIENCE_MS } from './until.mjs';

const executablePath = process.env.CHROMIUM || '/usr/bin/chromium';
const PLAIN = [
  '--headless=new',
  '--no-sandbox',
  '--disable-quic',
  '--no-first-run',
  '--disable-background-networking',
  '--disable-component-update',
  '--disable-sync',
];
const NATIVE = process.env.TMPI_WEBGPU === 'native';
// without a display a driver has no surfaces, and with them WebGPU would fall back to software
const WEBGPU = [
  '--enable-unsafe-webgpu',
  '--enable-features=Vulkan',
  ...(NATIVE
    ? ['--use-angle=vulkan', '--ignore-gpu-blocklist', '--disable-vulkan-surface']
    : ['--use-vulkan=swiftshader', '--use-angle=swiftshader']),
];
/** Names the address of the Chromium that all files share. */
export const SHARED = 'TMPI_CHROMIUM_SERVER';
/** Browsers whose pages are to have no WebGPU, although the browser that they share has it. */
const withoutWebGpu = new WeakSet();

/** What Playwright needs to start a browser. */
function options({ webgpu = true, more = [] } = {}) {
  if (!existsSync(executablePath)) throw new Error(`no Chromium at ${executablePath}: set CHROMIUM`);
  const args = [...PLAIN, ...(webgpu ? WEBGPU : ['--disable-features=WebGPU', '--disable-gpu']), ...more];
  return { executablePath, headless: false, args };
}

/** Starts the Chromium that test files share. */
export const launchShared = () => chromium.launchServer(options());

/** A browser whose pages have WebGPU or not: the shared one, but where it takes further arguments. */
export async function launch({ webgpu = true, more = [] } = {}) {
  const address = process.env[SHARED];
  if (!address || more.length) return chromium.launch(options({ webgpu, more }));
  const browser = await chromium.connect(address);
  if (!webgpu) withoutWebGpu.add(browser);
  return browser;
}

/** A page whose script errors fail the test: `errors` collects them. */
export async function openPage(browser, more = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, ...more });
  if (withoutWebGpu.has(browser)) await context.addInitScript(() => Object.defineProperty(navigator, 'gpu', { value: undefined }));
  const page = await context.newPage();
  page.setDefaultTimeout(PATIENCE_MS);
  const errors = [];
  page.on('pageerror', (error) => errors.push(error.message));
  page.on('console', (message) => {
    if (message.type() === 'error') errors.push(`${message.text()} ${message.location().url}`);
  });
  return { page, context, errors };
}

/** What axe-core finds of serious or critical hurdles on the page, as `rule: element`. */
export async function seriousViolations(page) {
  const path = createRequire(import.meta.url).resolve('axe-core');
  // past the page's own policy for scripts
  await page.evaluate(readFileSync(path, 'utf8'));
  return page.evaluate(async () => {
    const { violations } = await window.axe.run();
    const serious = violations.filter(({ impact }) => impact === 'serious' || impact === 'critical');
    return serious.flatMap(({ id, nodes }) => nodes.map((node) => `${id}: ${node.html}`));
  });
}

/** Takes WebGPU from the page, and WebGL too where `webgl` is false. */
export async function takeGraphics(page, { webgl }) {
  await page.addInitScript((keep) => {
    Object.defineProperty(navigator, 'gpu', { value: undefined });
    if (keep) return;
    for (const canvas of [HTMLCanvasElement, OffscreenCanvas]) {
      const { getContext } = canvas.prototype;
      canvas.prototype.getContext = function (kind, ...rest) {
        return /^webgl/.test(kind) ? null : getContext.call(this, kind, ...rest);
      };
    }
  }, webgl);
}

/** Waits until the viewer of the page shows something in `mode`. */
export async function waitForMode(page, mode) {
  await page.waitForFunction((wanted) => document.getElementById('stage').dataset.mode === wanted, mode);
}

/** Samples that a script of the page has made into text, as `TO_TEXT` does. */
const samples = (text) => new Uint8ClampedArray(Buffer.from(text, 'base64'));
/** Source of a function that makes samples into text, on its way out of a page. */
const TO_TEXT = `(data) => {
  let out = '';
  for (let i = 0; i < data.length; i += 32768) out += String.fromCharCode(...data.subarray(i, i + 32768));
  return btoa(out);
}`;

/** Samples that `script` gives in the page: a function of `given`, a value that JSON can carry. */
export async function samplesOf(page, script, given) {
  return samples(await page.evaluate(`(${script})(${JSON.stringify(given)}).then(${TO_TEXT})`));
}

/** Pixels of the viewer's scene at a pose, as the server would draw it; `of`: the element that has the viewer, else the page itself. */
export function pixelsAt(page, pose, width, height, of = null) {
  const script = async ({ pose, width, height, of }) => {
    const { viewer } = of ? document.querySelector(of) : window;
    viewer.setPose(pose);
    return viewer.readPixels(width, height);
  };
  return samplesOf(page, script, { pose, width, height, of });
}

/** Pixels of a picture file, decoded by the browser: one at an address, or the bytes of one; in its own size, or in another. */
export function pixelsOf(page, file, size = null) {
  const script = async ({ address, bytes, size }) => {
    const response = address ? await fetch(address) : null;
    if (response && !response.ok) throw new Error(`${response.status} ${await response.text()}`);
    const blob = response ? await response.blob() : new Blob([Uint8Array.from(atob(bytes), (c) => c.charCodeAt(0))]);
    const bitmap = await createImageBitmap(blob, { premultiplyAlpha: 'none', colorSpaceConversion: 'none' });
    const { width, height } = size ?? bitmap;
    const context = new OffscreenCanvas(width, height).getContext('2d');
    context.imageSmoothingQuality = 'high';
    context.drawImage(bitmap, 0, 0, width, height);
    return context.getImageData(0, 0, width, height).data;
  };
  const given = typeof file === 'string' ? { address: file } : { bytes: Buffer.from(file).toString('base64') };
  return samplesOf(page, script, { ...given, size });
}

/** Pixels of an image on the page, at a size; rejects while the browser has none of them. */
export function imagePixels(page, selector, width, height) {
  const script = async ({ selector, width, height }) => {
    const sized = { resizeWidth: width, resizeHeight: height, resizeQuality: 'high' };
    const bitmap = await createImageBitmap(document.querySelector(selector), sized);
    const context = new OffscreenCanvas(width, height).getContext('2d');
    context.drawImage(bitmap, 0, 0);
    return context.getImageData(0, 0, width, height).data;
  };
  return samplesOf(page, script, { selector, width, height });
}

/** Bytes of a file that a page has saved. */
export async function saved(download) {
  const parts = [];
  for await (const part of await download.createReadStream()) parts.push(part);
  return Buffer.concat(parts);
}

/** Share of the pixels in a rectangle (fractions of the picture) that differ by more than `levels` in any colour. */
export function shareDifferent(a, b, width, height, { levels = 8, x0 = 0, y0 = 0, x1 = 1, y1 = 1 } = {}) {
  if (a.length !== b.length || a.length !== width * height * 4) throw new Error(`pictures of ${a.length} and ${b.length} bytes`);
  let off = 0;
  let all = 0;
  for (let y = Math.floor(y0 * height); y < y1 * height; y++) {
    for (let x = Math.floor(x0 * width); x < x1 * width; x++) {
      const i = (y * width + x) * 4;
      all++;
      if ([0, 1, 2].some((c) => Math.abs(a[i + c] - b[i + c]) > levels)) off++;
    }
  }
  return off / all;
}
