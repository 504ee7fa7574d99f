// Temporal layers: the publisher's page marks every other frame as unreferenced.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { RoomDecoder } from '../../../static/live/decoder.js';
import { roomSuite } from '../support/room.mjs';

const module = new WebAssembly.Module(readFileSync(new URL('../../../static/live/decoder.wasm', import.meta.url)));

/** Fetches the messages of a group of pictures; each follows its length. */
async function fetchGroup(address) {
  const response = await fetch(address);
  assert.equal(response.status, 200);
  const bytes = Buffer.from(await response.arrayBuffer());
  const decoder = await RoomDecoder.of(module);
  const messages = [];
  for (let at = 0; at < bytes.length; ) {
    const length = bytes.readUInt32LE(at);
    messages.push(decoder.read(bytes.subarray(at + 4, at + 4 + length)));
    at += 4 + length;
  }
  return messages;
}

/** In the page: hashes of the decoded frames. */
async function decodeHashes({ codec, frames }) {
  const hashes = [];
  const waiting = [];
  const decoder = new VideoDecoder({
    output: (picture) => {
      const bytes = new Uint8Array(picture.allocationSize());
      const copied = picture.copyTo(bytes).then(async () => {
        const digest = new Uint8Array(await crypto.subtle.digest('SHA-256', bytes));
        hashes.push([picture.timestamp, String(digest)]);
        picture.close();
      });
      waiting.push(copied);
    },
    error: (error) => waiting.push(Promise.reject(error)),
  });
  decoder.configure({ codec, optimizeForLatency: true });
  for (const { frame, key, data } of frames) {
    const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
    decoder.decode(new EncodedVideoChunk({ type: key ? 'key' : 'delta', timestamp: frame, data: bytes }));
  }
  await decoder.flush();
  await Promise.all(waiting);
  return Object.fromEntries(hashes);
}

describe('temporal layers', () => {
  const suite = roomSuite();

  test('the base layer decodes alone, bit for bit', async () => {
    const publisher = await suite.publish('attic');
    await publisher.page.waitForFunction(() => window.publisher.counts.frames > 30);
    const messages = await fetchGroup(`${suite.server.url}/v1/live/attic/gops/latest`);
    const { codec } = messages.find(({ kind }) => kind === 'hello');
    const video = messages.filter(({ kind }) => kind === 'video');
    assert.ok(codec.startsWith('avc1.42') && video.length > 10, `${video.length} frames of ${codec}`);
    const upper = video.filter(({ layer }) => layer === 1);
    assert.ok(video[0].key && upper.every(({ key }) => !key));
    // an encoder may drop frames
    assert.ok(upper.length > video.length / 4 && upper.length < (3 * video.length) / 4, `${upper.length} of ${video.length}`);
    const frames = video.map(({ frame, key, layer, data }) => ({ frame, key, layer, data: Buffer.from(data).toString('base64') }));
    const all = await publisher.page.evaluate(decodeHashes, { codec, frames });
    const base = await publisher.page.evaluate(decodeHashes, { codec, frames: frames.filter(({ layer }) => layer === 0) });
    assert.equal(Object.keys(all).length, frames.length);
    assert.deepEqual(
      Object.keys(base),
      frames.filter(({ layer }) => layer === 0).map(({ frame }) => String(frame)),
    );
    for (const [frame, hash] of Object.entries(base)) assert.equal(hash, all[frame], `frame ${frame}`);
    assert.deepEqual(publisher.errors, []);
    await publisher.context.close();
  });
});
