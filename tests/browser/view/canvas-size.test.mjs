// Sizes of pictures on the page and of the canvas.
import assert from 'node:assert/strict';
import { afterEach, describe, test } from 'node:test';
import { fitted, pixelRatio, setPixels } from '../../../static/view/canvas-size.js';

const setPixelRatio = (ratio) => (globalThis.devicePixelRatio = ratio);

describe('canvas size', () => {
  afterEach(() => delete globalThis.devicePixelRatio);

  test('a picture fits whole and keeps its shape', () => {
    assert.deepEqual(fitted({ clientWidth: 400, clientHeight: 400 }, 2), { width: 400, height: 200 });
    assert.deepEqual(fitted({ clientWidth: 400, clientHeight: 100 }, 2), { width: 200, height: 100 });
    assert.equal(fitted({ clientWidth: 0, clientHeight: 100 }, 2), null);
  });

  test('uses at most two device pixels per CSS pixel', () => {
    setPixelRatio(3);
    assert.equal(pixelRatio(), 2);
    setPixelRatio(1.5);
    assert.equal(pixelRatio(), 1.5);
  });

  test('limits total pixels and side length', () => {
    setPixelRatio(2);
    const sizeFor = (size, detail, side) => {
      const canvas = { width: 0, height: 0 };
      setPixels(canvas, size, detail, side);
      return [canvas.width, canvas.height];
    };
    assert.deepEqual(sizeFor({ width: 300, height: 200 }, 1, 8192), [600, 400]);
    assert.deepEqual(sizeFor({ width: 300, height: 200 }, 0.5, 8192), [300, 200]);
    assert.deepEqual(sizeFor({ width: 1000, height: 10 }, 1, 500), [500, 5]);
    const [w, h] = sizeFor({ width: 4000, height: 3000 }, 1, 16_384);
    assert.ok(w * h <= 6_001_000 && w * h > 5_990_000, `${w} × ${h}`);
    assert.deepEqual(sizeFor({ width: 0.1, height: 0.1 }, 1, 8192), [1, 1]);
  });

  // setting a size clears the canvas
  test('does not set an unchanged size', () => {
    setPixelRatio(1);
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
