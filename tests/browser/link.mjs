// Time to the first picture and to the whole scene over slow links, in Chromium: the container against other ways to send the same
// layers. Not a test; run by hand on the files that `tmpi bench codec --files` writes:
//   node link.mjs DIR/PHOTO [--mbps 1,5,50] [--latency 40] [--runs 3] [--json FILE]
// The link is shaped by the server, which answers after the latency and then sends at the rate: that holds for the page and for its
// workers alike. Both times begin with the request, on a connection that is open already.
import { createReadStream, readdirSync, readFileSync, statSync, writeFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { extname, join } from 'node:path';
import { fileURLToPath } from 'node:url';
import { parseArgs } from 'node:util';
import { launch } from './support/browser.mjs';

const STATIC = fileURLToPath(new URL('../../static/', import.meta.url));
const TYPES = {
  '.js': 'text/javascript',
  '.wasm': 'application/wasm',
  '.png': 'image/png',
  '.webp': 'image/webp',
  '.tmpi': 'application/vnd.tmpi',
};
const TICK_MS = 5;

const { values, positionals } = parseArgs({
  allowPositionals: true,
  options: {
    mbps: { type: 'string', default: '1,5,50' },
    latency: { type: 'string', default: '40' },
    runs: { type: 'string', default: '3' },
    json: { type: 'string' },
  },
});
if (positionals.length !== 1) {
  console.error('usage: node link.mjs DIR/PHOTO [--mbps 1,5,50] [--latency MS] [--runs N] [--json FILE]');
  process.exit(2);
}
const folder = positionals[0];
const link = { bytesPerMs: 0, latency: Number(values.latency) };
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

/** Sends bytes at the rate of the link, by the clock, so that late timers make up for it. */
async function send(response, bytes) {
  const start = performance.now();
  let sent = 0;
  while (sent < bytes.length && !response.destroyed) {
    const due = Math.min(Math.ceil((performance.now() - start + TICK_MS) * link.bytesPerMs), bytes.length);
    if (due > sent) response.write(bytes.subarray(sent, due));
    sent = Math.max(sent, due);
    await sleep(TICK_MS);
  }
  response.end();
}

const server = createServer(async (request, response) => {
  const path = decodeURIComponent(new URL(request.url, 'http://x').pathname);
  if (path === '/') return response.writeHead(200, { 'content-type': 'text/html' }).end('<!doctype html><title>link</title>');
  if (path.startsWith('/link/')) {
    const bytes = readFileSync(join(folder, path.slice(6)));
    const headers = {
      'content-type': TYPES[extname(path)] ?? 'application/octet-stream',
      'content-length': bytes.length,
      'cache-control': 'no-store',
    };
    if (extname(path) === '.zst') headers['content-encoding'] = 'zstd';
    await sleep(link.latency);
    response.writeHead(200, headers);
    return send(response, bytes);
  }
  return createReadStream(join(STATIC, path))
    .on('error', () => response.writeHead(404).end())
    .once('open', () => response.writeHead(200, { 'content-type': TYPES[extname(path)] ?? 'text/plain' }))
    .pipe(response);
});

/** In the page: milliseconds to the photo on screen's memory, to the whole scene, and of decoding alone. */
async function container(url) {
  const { Decoder } = await import('/decode/start.js');
  const worker = new Decoder();
  const start = performance.now();
  return new Promise((done, fail) => {
    let first = 0;
    worker.onmessage = async ({ data }) => {
      if (data.type === 'error') fail(new Error(data.message));
      if (data.type === 'photo') {
        (await createImageBitmap(data.blob)).close();
        first = performance.now() - start;
      }
      if (data.type === 'scene') {
        done({ first, whole: performance.now() - start, decode: data.scene.decodeMs });
        worker.terminate();
      }
    };
    worker.postMessage({ url: new URL(url, location.href).href, photoOnly: false });
  });
}

/** The same for layers in one file: nothing can be shown before all of it is there. */
async function layers({ url, picture }) {
  const start = performance.now();
  const response = await fetch(url);
  const bytes = await response.arrayBuffer();
  const received = performance.now();
  // a browser undoes the coding of zstd while it receives
  if (picture) (await createImageBitmap(new Blob([bytes]), { premultiplyAlpha: 'none' })).close();
  const whole = performance.now() - start;
  return { first: whole, whole, decode: start + whole - received };
}

const median = (list) => list.sort((a, b) => a - b)[list.length >> 1];
await new Promise((ready) => server.listen(0, '127.0.0.1', ready));
const browser = await launch({ webgpu: false });
const page = await browser.newPage();
await page.goto(`http://127.0.0.1:${server.address().port}/`);
const files = readdirSync(folder).filter(
  (name) => name === 'tmpi.tmpi' || (name.startsWith('layers') && ['.zst', '.png', '.webp'].includes(extname(name))),
);
files.sort((a, b) => statSync(join(folder, a)).size - statSync(join(folder, b)).size);
const results = [];
console.log(
  `${'file'.padEnd(34)}${'KB'.padStart(9)}${'Mb/s'.padStart(7)}${'first ms'.padStart(10)}${'whole ms'.padStart(10)}${'decode ms'.padStart(11)}`,
);
for (const mbps of values.mbps.split(',').map(Number)) {
  link.bytesPerMs = (mbps * 1e6) / 8 / 1000;
  for (const file of files) {
    const url = `/link/${encodeURIComponent(file)}`;
    const runs = [];
    for (let i = 0; i < Number(values.runs); i++) {
      runs.push(
        await (file === 'tmpi.tmpi' ? page.evaluate(container, url) : page.evaluate(layers, { url, picture: extname(file) !== '.zst' })),
      );
    }
    const of = (key) => median(runs.map((run) => run[key]));
    const row = { file, bytes: statSync(join(folder, file)).size, mbps, first: of('first'), whole: of('whole'), decode: of('decode') };
    results.push(row);
    const cell = (value, width, digits = 0) => value.toFixed(digits).padStart(width);
    console.log(
      `${file.padEnd(34)}${cell(row.bytes / 1000, 9, 1)}${cell(mbps, 7)}${cell(row.first, 10)}${cell(row.whole, 10)}${cell(row.decode, 11, 1)}`,
    );
  }
}
if (values.json) writeFileSync(values.json, `${JSON.stringify({ latency: link.latency, runs: Number(values.runs), results }, null, 1)}\n`);
await browser.close();
server.close();
