// A browser decodes H.264 and VP9 to the same planes as the server, bit for bit: both match the hashes in crates/live/tests/video.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { after, before, describe, test } from 'node:test';
import { launch, openPage } from '../support/browser.mjs';

const file = (name) => readFileSync(new URL(`../../../crates/live/tests/video/${name}`, import.meta.url));
const [SLICE, KEY, PARAMETERS] = [1, 5, 7];

/** Splits a stream into access units with one slice each. */
function accessUnits(stream) {
  const starts = [];
  for (let at = stream.indexOf('000001', 0, 'hex'); at >= 0; at = stream.indexOf('000001', at + 3, 'hex')) starts.push(at);
  const out = [];
  for (const [i, at] of starts.entries()) {
    const kind = stream[at + 3] & 31;
    const data = stream.subarray(at, starts[i + 1]);
    if (!out.length || out.at(-1).whole) out.push({ key: false, whole: false, data: [] });
    const unit = out.at(-1);
    unit.data.push(data);
    unit.key ||= kind === KEY;
    unit.whole = kind === SLICE || kind === KEY;
  }
  return out.map(({ key, data }) => ({ key, data: Buffer.concat(data).toString('base64') }));
}

/** Frames of an IVF file. */
function ivfFrames(ivf) {
  const out = [];
  for (let at = 32; at < ivf.length; ) {
    const length = ivf.readUInt32LE(at);
    const data = ivf.subarray(at + 12, at + 12 + length);
    // uncompressed header: 2 bits frame marker, 2 bits profile, show_existing_frame, frame_type (0: key frame)
    out.push({ key: !(data[0] & 0b100), data: data.toString('base64') });
    at += 12 + length;
  }
  return out;
}

/** Codec string from the stream's parameter set. */
function codecOf(stream) {
  const at = stream.indexOf('000001', 0, 'hex') + 3;
  assert.equal(stream[at] & 31, PARAMETERS);
  return `avc1.${stream.subarray(at + 1, at + 4).toString('hex')}`;
}

/** In the page: hashes of the decoded planes of each frame. */
async function decodeHashes({ codec, frames }) {
  const { pixelsOf } = await import('/live/pixels.js');
  const { PIXELS } = await import('/live/decoder.js');
  const { FrameDecoder } = await import('/live/frame-decoder.js');
  const hashes = [];
  let last = Promise.resolve();
  let [done, failed] = [null, null];
  const all = new Promise((resolve, reject) => ([done, failed] = [resolve, reject]));
  const taken = async ({ picture, frame }) => {
    const { width, height } = picture.visibleRect;
    const { format, bytes } = await pixelsOf(picture, { width, height }, true);
    picture.close();
    const digest = new Uint8Array(await crypto.subtle.digest('SHA-256', bytes));
    hashes.push(format === PIXELS.I420 ? Array.from(digest, (byte) => byte.toString(16).padStart(2, '0')).join('') : `format ${format}`);
    if (frame === frames.length - 1) done();
  };
  const pictures = await FrameDecoder.of(codec, (of) => (last = last.then(() => taken(of))), failed);
  for (const [frame, { key, data }] of frames.entries()) {
    const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
    pictures.decode({ frame, time: 0, key, layer: 0, data: bytes }, 0);
  }
  await all;
  return hashes;
}

describe('decoded planes of a browser', () => {
  let [server, browser, page] = [null, null, null];
  before(async () => {
    const pages = new URL('../../../static/', import.meta.url);
    server = createServer((request, response) => {
      const script = request.url.endsWith('.js');
      response.writeHead(200, { 'content-type': script ? 'text/javascript' : 'text/html' });
      response.end(script ? readFileSync(new URL(`.${request.url}`, pages)) : '<!doctype html><title>planes</title>');
    });
    await new Promise((ready) => server.listen(0, '127.0.0.1', ready));
    browser = await launch({ webgpu: false });
    ({ page } = await openPage(browser));
    await page.goto(`http://127.0.0.1:${server.address().port}/`);
  });
  after(async () => {
    await browser?.close();
    server?.close();
  });

  /** Hashes in an ffmpeg framehash file. */
  const hashesOf = (name) => {
    const table = file(`${name}.framehash`).toString().split('\n');
    return table.filter((line) => line && !line.startsWith('#')).map((line) => line.split(', ').at(-1).trim());
  };
  const check = async (codec, frames, expected) => {
    assert.ok(frames.length === expected.length && frames[0].key && !frames[1].key);
    assert.deepEqual(await page.evaluate(decodeHashes, { codec, frames }), expected);
  };

  for (const name of ['testsrc', 'layers']) {
    test(`equal those of ffmpeg and the server: ${name}`, async () => {
      const stream = file(`${name}.h264`);
      await check(codecOf(stream), accessUnits(stream), hashesOf(name));
    });
  }

  test('equal those of ffmpeg and the server: VP9', async () => {
    await check('vp09.00.10.08', ivfFrames(file('testsrc.ivf')), hashesOf('testsrc-vp9'));
  });
});
