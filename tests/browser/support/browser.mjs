// Chromium for the tests, with WebGPU on a software rasteriser; TMPI_WEBGPU=native takes the machine's GPU.
import { existsSync } from 'node:fs';
import { createRequire } from 'node:module';
import { chromium } from 'playwright-core';

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
/** Software drawing on a busy machine takes its time. */
export const PATIENCE_MS = 60_000;

/** A browser, with WebGPU or without, and with further arguments. */
export async function launch({ webgpu = true, more = [] } = {}) {
  if (!existsSync(executablePath)) throw new Error(`no Chromium at ${executablePath}: set CHROMIUM`);
  const args = [...PLAIN, ...(webgpu ? WEBGPU : ['--disable-features=WebGPU', '--disable-gpu']), ...more];
  return chromium.launch({ executablePath, headless: false, args });
}

/** A page whose script errors fail the test: `errors` collects them. */
export async function openPage(browser, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, ...options });
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
  const { readFile } = await import('node:fs/promises');
  await page.evaluate(await readFile(path, 'utf8'));
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

/** Pixels of the viewer's scene at a pose, as the server would draw it. */
export async function pixelsAt(page, pose, width, height) {
  const text = await page.evaluate(
    async ([p, w, h]) => {
      window.viewer.setPose(p);
      const data = await window.viewer.readPixels(w, h);
      let out = '';
      for (let i = 0; i < data.length; i += 32_768) out += String.fromCharCode(...data.subarray(i, i + 32_768));
      return btoa(out);
    },
    [pose, width, height],
  );
  return new Uint8ClampedArray(Buffer.from(text, 'base64'));
}

/** Pixels of a picture file, decoded by the browser. */
export async function pixelsOf(page, address) {
  const text = await page.evaluate(async (url) => {
    const response = await fetch(url);
    if (!response.ok) throw new Error(`${response.status} ${await response.text()}`);
    const bitmap = await createImageBitmap(await response.blob(), { premultiplyAlpha: 'none', colorSpaceConversion: 'none' });
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext('2d');
    context.drawImage(bitmap, 0, 0);
    const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    let out = '';
    for (let i = 0; i < data.length; i += 32_768) out += String.fromCharCode(...data.subarray(i, i + 32_768));
    return btoa(out);
  }, address);
  return new Uint8ClampedArray(Buffer.from(text, 'base64'));
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
