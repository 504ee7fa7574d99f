// Reading the samples of decoded pictures.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { PictureReader } from '../../../static/live/pixels.js';

const SIZE = { width: 4, height: 2 };

/** A picture whose samples are `value`, copied when `copied` settles; `log` gets its name when it is closed. */
const picture = (value, copied, log) => ({
  format: 'I420',
  visibleRect: { x: 0, y: 0, ...SIZE },
  codedWidth: SIZE.width,
  codedHeight: SIZE.height,
  async copyTo(bytes) {
    await copied;
    bytes.fill(value);
  },
  close: () => log.push(`closed ${value}`),
});

describe('the reader of pictures', () => {
  test('reads and closes them in order, whichever copy is fast', async () => {
    const [reader, log] = [new PictureReader(), []];
    let copied;
    const slow = new Promise((resolve) => (copied = resolve));
    const reads = [picture(1, slow, log), picture(2, null, log), picture(3, null, log)].map((one) =>
      reader.read(one, SIZE).then(({ bytes }) => log.push(`read ${bytes[0]}`)),
    );
    assert.ok(reader.full);
    copied();
    await Promise.all(reads);
    assert.ok(!reader.full);
    assert.deepEqual(
      log.filter((line) => line.startsWith('read')),
      ['read 1', 'read 2', 'read 3'],
    );
    assert.deepEqual(
      log.filter((line) => line.startsWith('closed')),
      ['closed 1', 'closed 2', 'closed 3'],
    );
  });

  test('reads the next picture after an error or a copy that never ends', async () => {
    const [reader, log] = [new PictureReader(), []];
    const failed = reader.read(picture(1, Promise.reject(new Error('lost')), log), SIZE);
    const stuck = reader.read(picture(2, new Promise(() => {}), log), SIZE);
    await assert.rejects(failed, /lost/);
    assert.equal(await stuck, null);
    assert.deepEqual(log, ['closed 1', 'closed 2']);
    assert.ok(!reader.full);
  });
});
