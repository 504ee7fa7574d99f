// The room decoder, with the seeds of its fuzzer as messages.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { beforeEach, describe, test } from 'node:test';
import { EVERYTHING, SOUND_ALONE } from '../../../static/live/connection.js';
import { PIXELS, RoomDecoder } from '../../../static/live/decoder.js';
import { TileAtlas } from '../../../static/live/tile-atlas.js';

const file = (path) => readFileSync(new URL(`../../../${path}`, import.meta.url));
const module = new WebAssembly.Module(file('static/live/decoder.wasm'));
/** A frame after those of the seeds' tiles. */
const LATER = { frame: 1000, time: 0 };
const seed = (name) => file(`fuzz/seeds/message/${name}`);

describe('the room decoder', () => {
  /** @type {RoomDecoder} */
  let decoder;
  let head;
  beforeEach(async () => {
    decoder = await RoomDecoder.of(module);
    ({ head } = decoder.read(seed('hello')));
  });

  /** A picture of the room's size without equal neighbours. */
  const picture = () =>
    Uint8Array.from({ length: head.width * head.height * 4 }, (_, i) => (i % 4 === 3 ? 255 : (i * 37 + Math.floor(i / 520) * 11) % 256));

  test('shows nothing until all tiles have arrived', () => {
    const rgba = picture();
    decoder.frame(PIXELS.RGBA, rgba, LATER);
    assert.deepEqual(decoder.layers(), []);
    assert.equal(decoder.read(seed('geometry')).kind, 'tiles');
    assert.deepEqual(decoder.layers(), [], 'two tiles are missing');
    decoder.read(seed('snapshot'));
    const changed = decoder.layers();
    assert.equal(changed.length, 6);
    const atlas = new TileAtlas(head, 2048);
    const { numbers } = atlas.change(changed);
    const cells = decoder.cells(numbers, 0);
    const same = new Uint8Array(head.width * head.height);
    let end = 0;
    for (let k = 0; k < numbers.length; k += 2) {
      const [tile, layer] = numbers.subarray(k, k + 2);
      const [, , , x, y, w, h] = changed[tile].layers[layer];
      const first = end;
      end += w * h * 4;
      for (let j = 0; j < h; j++) {
        for (let i = 0; i < w; i++) {
          const at = first + (j * w + i) * 4;
          const pixel = (y + j) * head.width + x + i;
          if (cells[at + 3] === 255 && [0, 1, 2].every((c) => cells[at + c] === rgba[pixel * 4 + c])) same[pixel] = 1;
        }
      }
    }
    assert.equal(end, cells.length);
    const again = decoder.cells(numbers, 0, new ArrayBuffer(cells.length + 9));
    assert.deepEqual(again, cells);
    assert.equal(again.buffer.byteLength, cells.length + 9, 'the decoder reuses the given buffer');
    assert.deepEqual(decoder.cells(numbers, 0, new ArrayBuffer(9)), cells, 'a small buffer is replaced');
    assert.ok(same.every(Boolean), `${same.filter((v) => !v).length} pixels are in no layer`);
  });

  test('keeps tiles until their frame has been decoded', () => {
    const rgba = picture();
    decoder.frame(PIXELS.RGBA, rgba);
    const { frame, changed } = decoder.read(seed('snapshot'));
    assert.ok(frame > 0);
    assert.deepEqual([changed, decoder.layers()], [0, []]);
    decoder.frame(PIXELS.RGBA, rgba, { frame, time: 0 });
    assert.equal(decoder.layers().length, 6);
  });

  test('keeps tiles only for frames that will come soon', () => {
    const rgba = picture();
    const { frame } = decoder.read(seed('snapshot'));
    const ahead = (frames) => {
      decoder.read(seed('hello'));
      decoder.frame(PIXELS.RGBA, rgba, { frame: frame - frames, time: 0 });
      return decoder.read(seed('snapshot')).changed;
    };
    assert.deepEqual([ahead(frame), ahead(0), ahead(-30)], [0, 6, 6]);
    // another publisher's first frame has not come
    decoder.frame(PIXELS.RGBA, rgba);
    decoder.read(seed('snapshot'));
    decoder.read(seed('hello'));
    assert.equal(decoder.read(seed('snapshot')).changed, 6);
  });

  test('rejects a frame whose kept tiles are broken, and shows the next one', () => {
    const rgba = picture();
    decoder.frame(PIXELS.RGBA, rgba);
    const broken = seed('snapshot');
    broken[broken.length - 1] ^= 255;
    broken[broken.length - 9] ^= 255;
    assert.equal(decoder.read(broken).changed, 0);
    assert.throws(() => decoder.frame(PIXELS.RGBA, rgba, LATER));
    decoder.read(seed('snapshot'));
    decoder.frame(PIXELS.RGBA, rgba, LATER);
    assert.equal(decoder.layers().length, 6);
  });

  test('adds the means along the borders as the atlas places them', () => {
    const rgba = picture();
    decoder.frame(PIXELS.RGBA, rgba, LATER);
    decoder.read(seed('snapshot'));
    const changed = decoder.layers();
    const atlas = new TileAtlas(head, 2048);
    const { numbers, places } = atlas.change(changed);
    const cells = decoder.cells(numbers, atlas.borderColumns);
    const texels = decoder.cells(numbers, 0);
    const [w, h] = places.subarray(-2);
    assert.equal(cells.length, texels.length + w * h * 4);
    assert.ok(Buffer.from(cells.subarray(0, texels.length)).equals(Buffer.from(texels)));
    const texel = (row, column) => [...cells.subarray(texels.length + (row * w + column) * 4).subarray(0, 4)];
    const pixel = (x, y) => [...rgba.subarray((y * head.width + x) * 4).subarray(0, 4)];
    // of squares of one pixel, for each border
    const [right, lower] = [head.width - 1, head.height - 1];
    for (let y = 0; y < head.height; y++) assert.deepEqual([texel(0, y), texel(7, y)], [pixel(0, y), pixel(right, y)], `row ${y}`);
    for (let x = 0; x < head.width; x++) assert.deepEqual([texel(14, x), texel(21, x)], [pixel(x, 0), pixel(x, lower)], `column ${x}`);
  });

  test('reports which tiles a frame changes', () => {
    decoder.read(seed('geometry'));
    decoder.read(seed('snapshot'));
    const rgba = picture();
    decoder.frame(PIXELS.RGBA, rgba);
    assert.equal(decoder.layers().length, 6);
    decoder.frame(PIXELS.RGBA, rgba);
    assert.deepEqual(decoder.layers(), []);
    rgba[0] ^= 255;
    decoder.frame(PIXELS.RGBA, rgba);
    const changed = decoder.layers();
    assert.ok(
      changed.some(({ tile }) => tile === 0) && !changed.some(({ tile }) => tile === 5),
      'the first tile changed, the last did not',
    );
    assert.ok(
      changed.every(({ layers }) => layers === null),
      'the layers are unchanged',
    );
  });

  test('converts camera planes as the server does', () => {
    decoder.read(seed('geometry'));
    decoder.read(seed('snapshot'));
    const { width, height } = head;
    const bytes = new Uint8Array(width * height + 2 * Math.ceil(width / 2) * Math.ceil(height / 2)).fill(128);
    bytes.fill(235, 0, width * height);
    decoder.frame(PIXELS.I420, bytes);
    assert.equal(decoder.layers().length, 6);
    decoder.frame(PIXELS.NV12, bytes);
    assert.deepEqual(decoder.layers(), [], 'grey is the same in both formats');
    const white = new Uint8Array(width * height * 4).fill(255);
    decoder.frame(PIXELS.RGBA, white);
    assert.deepEqual(decoder.layers(), [], 'luma 235 is white');
  });

  test('reads the messages that it writes', () => {
    const data = Uint8Array.of(0, 0, 1, 0x65, 7);
    const time = 1_790_000_000_123_456;
    const colour = { matrix: 'bt709', fullRange: false };
    // from the last HELLO
    const shown = { x: 0, y: 0, width: head.width, height: head.height };
    assert.deepEqual(decoder.read(decoder.writeVideo({ frame: 77, time, key: true, data })), {
      kind: 'video',
      frame: 77,
      time,
      key: true,
      layer: 0,
      colour,
      shown,
      data,
    });
    for (const layer of [1, 2, 300]) {
      const video = { frame: 78, time, key: false, layer, data };
      const message = decoder.writeVideo(video);
      assert.deepEqual(decoder.read(message), { kind: 'video', colour, shown, ...video });
      // the message is one `video` field (2)
      assert.deepEqual([...message.subarray(0, 2)], [(2 << 3) | 2, message.length - 2]);
    }
    assert.deepEqual(decoder.read(decoder.writeSound({ time, data })), { kind: 'sound', time, data });
    assert.deepEqual(decoder.read(decoder.writeBye('enough')), { kind: 'bye', reason: 'enough', again: false, cause: 'other' });
    const hello = decoder.writeHello({ width: 320, height: 240, codec: 'avc1.42e01f', sound: 'opus', rate: 48_000, channels: 1 });
    assert.ok(Buffer.from(hello).includes('avc1.42e01f') && Buffer.from(hello).includes('opus'));
  });

  test('hidden and visible pages send CREDIT', () => {
    assert.deepEqual(decoder.read(SOUND_ALONE), { kind: 'credit', frames: 0, key: false });
    assert.deepEqual(decoder.read(EVERYTHING), { kind: 'credit', frames: 1, key: true });
  });

  test('rejects corrupted messages and reads the next one', () => {
    const broken = Uint8Array.from(seed('geometry'));
    broken[broken.length - 3] ^= 1;
    assert.throws(() => decoder.read(broken), /damaged|planes|range/);
    assert.throws(() => decoder.read(Uint8Array.of(1, 2, 3)), /message/);
    assert.throws(() => decoder.frame(PIXELS.I420, new Uint8Array(5)), /5 bytes/);
    assert.equal(decoder.read(seed('bye')).reason, 'the end');
  });
});
