// Sizes of pictures on the page and of the canvas's pixels.
import assert from 'node:assert/strict';
import { afterEach, describe, test } from 'node:test';
import { fitted, pixelRatio, setPixels } from '../../../static/view/canvas-size.js';

const screenOf = (ratio) => (globalThis.devicePixelRatio = ratio);

describe('canvas size', () => {
  afterEach(() => delete globalThis.devicePixelRatio);

  test('a picture fits whole, in its own shape', () => {
    assert.deepEqual(fitted({ clientWidth: 400, clientHeight: 400 }, 2), { width: 400, height: 200 });
    assert.deepEqual(fitted({ clientWidth: 400, clientHeight: 100 }, 2), { width: 200, height: 100 });
    assert.equal(fitted({ clientWidth: 0, clientHeight: 100 }, 2), null);
  });

  test('at most two device pixels a pixel', () => {
    screenOf(3);
    assert.equal(pixelRatio(), 2);
    screenOf(1.5);
    assert.equal(pixelRatio(), 1.5);
  });

  test('neither more pixels than a bound nor a side longer than the device has, and fewer while moving', () => {
    screenOf(2);
    const of = (size, detail, side) => {
      const canvas = { width: 0, height: 0 };
      setPixels(canvas, size, detail, side);
      return [canvas.width, canvas.height];
    };
    assert.deepEqual(of({ width: 300, height: 200 }, 1, 8192), [600, 400]);
    assert.deepEqual(of({ width: 300, height: 200 }, 0.5, 8192), [300, 200]);
    assert.deepEqual(of({ width: 1000, height: 10 }, 1, 500), [500, 5]);
    const [w, h] = of({ width: 4000, height: 3000 }, 1, 16_384);
    assert.ok(w * h <= 6_001_000 && w * h > 5_990_000, `${w} × ${h}`);
    assert.deepEqual(of({ width: 0.1, height: 0.1 }, 1, 8192), [1, 1]);
  });

  test('a size that stays is not set, which would clear the canvas', () => {
    screenOf(1);
    let sets = 0;
    const canvas = {
      size: [300, 200],
      get width() {
        return this.size[0];
      },
      set width(v) {
        sets++;
        this.size[0] = v;
      },
      get height() {
        return this.size[1];
      },
      set height(v) {
        sets++;
        this.size[1] = v;
      },
    };
    setPixels(canvas, { width: 300, height: 200 }, 1, 8192);
    assert.equal(sets, 0);
    setPixels(canvas, { width: 301, height: 200 }, 1, 8192);
    assert.equal(sets, 2);
  });
});
