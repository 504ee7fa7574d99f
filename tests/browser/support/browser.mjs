// Chromium for the tests, with WebGPU on a software rasteriser; TMPI_WEBGPU=native uses the machine's GPU. All files share the browser that run.mjs
// starts; a file that runs alone starts its own.
import { existsSync, readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { join } from 'node:path';
import { chromium } from 'playwright-core';
import { POLL_MS, TIMEOUT_MS } from './until.mjs';
import { writeFilm } from './video.mjs';

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
// with Vulkan, Chromium paints pages on the GPU, too, which is slow in software: the processor paints them faster without
const SOFTWARE = ['--use-vulkan=swiftshader', '--use-angle=swiftshader', '--disable-gpu-rasterization'];
// without a display the driver has no surfaces, so disable them, else WebGPU falls back to software
const WEBGPU = [
  '--enable-unsafe-webgpu',
  '--enable-features=Vulkan',
  ...(NATIVE ? ['--use-angle=vulkan', '--ignore-gpu-blocklist', '--disable-vulkan-surface'] : SOFTWARE),
];
/** Environment variable with the address of the shared Chromium. */
export const SHARED = 'TMPI_CHROMIUM_SERVER';
/** Environment variable with the address of the shared Chromium that has a camera. */
export const SHARED_CAMERA = 'TMPI_CAMERA_SERVER';
/** Connections whose pages get no WebGPU although the shared browser has it. */
const withoutWebGpu = new WeakSet();

/** Launch options for Playwright. */
function launchOptions({ webgpu = true, more = [] } = {}) {
  if (!existsSync(executablePath)) throw new Error(`no Chromium at ${executablePath}: set CHROMIUM`);
  const args = [...PLAIN, ...(webgpu ? WEBGPU : ['--disable-features=WebGPU', '--disable-gpu']), ...more];
  return { executablePath, headless: false, args };
}

/** Starts the Chromium that test files share. */
export const launchShared = () => chromium.launchServer(launchOptions());

/** Launch options of a browser without WebGPU whose camera plays the film, which is written in `folder`. */
const cameraOptions = (folder) => {
  const film = join(folder, 'film.y4m');
  writeFilm(film);
  const more = ['--use-fake-device-for-media-stream', '--use-fake-ui-for-media-stream', `--use-file-for-fake-video-capture=${film}`];
  return launchOptions({ webgpu: false, more });
};

/** Starts the Chromium with a camera that test files share. */
export const launchSharedCamera = (folder) => chromium.launchServer(cameraOptions(folder));

/** A browser with a camera: the shared one, or its own with a film in `folder`. */
export async function launchCamera(folder) {
  const address = process.env[SHARED_CAMERA];
  return address ? chromium.connect(address) : chromium.launch(cameraOptions(folder));
}

/** A browser with or without WebGPU: the shared one, or its own with further arguments. */
export async function launch({ webgpu = true, more = [] } = {}) {
  const address = process.env[SHARED];
  if (!address || more.length) return chromium.launch(launchOptions({ webgpu, more }));
  const browser = await chromium.connect(address);
  if (!webgpu) withoutWebGpu.add(browser);
  return browser;
}

/** Page options for idle motion. By default pages rest until the test moves the camera, because software rendering is slow. */
export const MOTION = { reducedMotion: 'no-preference' };
/** Size of a page without further options. */
export const VIEWPORT = { width: 800, height: 500 };
/** Page options for rooms: smaller, because rooms draw all the time. */
export const ROOM = { viewport: { width: 700, height: 520 } };

/** Opens a page; `errors` collects script and console errors. */
export async function openPage(browser, more = {}) {
  const context = await browser.newContext({ viewport: VIEWPORT, reducedMotion: 'reduce', ...more });
  if (withoutWebGpu.has(browser)) await context.addInitScript(() => Object.defineProperty(navigator, 'gpu', { value: undefined }));
  const page = await context.newPage();
  page.setDefaultTimeout(TIMEOUT_MS);
  // by default the browser draws a frame for each check, which is slow without a GPU
  const waitForFunction = page.waitForFunction.bind(page);
  page.waitForFunction = (condition, argument, options) => waitForFunction(condition, argument, { polling: POLL_MS, ...options });
  const errors = [];
  page.on('pageerror', (error) => errors.push(error.message));
  page.on('console', (message) => {
    if (message.type() === 'error') errors.push(`${message.text()} ${message.location().url}`);
  });
  return { page, context, errors };
}

/** Serious and critical accessibility violations that axe-core finds, as `rule: element`. */
export async function seriousViolations(page) {
  const path = createRequire(import.meta.url).resolve('axe-core');
  // evaluate bypasses the page's script policy
  await page.evaluate(readFileSync(path, 'utf8'));
  return page.evaluate(async () => {
    const { violations } = await window.axe.run({ resultTypes: ['violations'] });
    const serious = violations.filter(({ impact }) => impact === 'serious' || impact === 'critical');
    return serious.flatMap(({ id, nodes }) => nodes.map((node) => `${id}: ${node.html}`));
  });
}

/** Disables WebGPU on the page, and WebGL too if `webgl` is false. */
export async function disableGraphics(page, { webgl }) {
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

/** Waits until the page's viewer draws in `mode`. */
export async function waitForMode(page, mode) {
  await page.waitForFunction((wanted) => document.getElementById('stage').dataset.mode === wanted, mode);
}

/** Decodes the text of `TO_TEXT`. */
const fromText = (text) => new Uint8ClampedArray(Buffer.from(text, 'base64'));
/** Source of a function that encodes bytes as base64 in the page. */
const TO_TEXT = `(data) => {
  let out = '';
  for (let i = 0; i < data.length; i += 32768) out += String.fromCharCode(...data.subarray(i, i + 32768));
  return btoa(out);
}`;

/** Bytes that `script` returns in the page, much faster than an array of numbers; `given`, its argument, must be valid JSON. */
export async function evaluateBytes(page, script, given = null) {
  return fromText(await page.evaluate(`(${script})(${JSON.stringify(given)}).then(${TO_TEXT})`));
}

/** Pixels of the viewer's scene at a pose; `selector`: the element with the viewer, else the page's. */
export function pixelsAt(page, pose, width, height, selector = null) {
  const script = async ({ pose, width, height, selector }) => {
    const { viewer } = selector ? document.querySelector(selector) : window;
    viewer.setPose(pose);
    return viewer.readPixels(width, height);
  };
  return evaluateBytes(page, script, { pose, width, height, selector });
}

/** Pixels of a picture file, decoded by the browser; `file`: a URL or bytes, `size`: resizes the picture. */
export function filePixels(page, file, size = null) {
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
  return evaluateBytes(page, script, { ...given, size });
}

/** Pixels of an image on the page, resized; rejects while it is not loaded. */
export function imagePixels(page, selector, width, height) {
  const script = async ({ selector, width, height }) => {
    const sized = { resizeWidth: width, resizeHeight: height, resizeQuality: 'high' };
    const bitmap = await createImageBitmap(document.querySelector(selector), sized);
    const context = new OffscreenCanvas(width, height).getContext('2d');
    context.drawImage(bitmap, 0, 0);
    return context.getImageData(0, 0, width, height).data;
  };
  return evaluateBytes(page, script, { selector, width, height });
}

/** Bytes of a downloaded file. */
export async function downloadBytes(download) {
  const parts = [];
  for await (const part of await download.createReadStream()) parts.push(part);
  return Buffer.concat(parts);
}

/** Fraction of the pixels in a rectangle (fractions of the picture) that differ by more than `levels` in any channel. */
export function fractionDifferent(a, b, width, height, { levels = 8, x0 = 0, y0 = 0, x1 = 1, y1 = 1 } = {}) {
  if (a.length !== b.length || a.length !== width * height * 4) throw new Error(`pictures have ${a.length} and ${b.length} bytes`);
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
