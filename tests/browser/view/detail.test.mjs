// Finer parts of large photos.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { partAddress, visiblePart } from '../../../static/view/detail.js';

const PHOTO = { width: 6000, height: 4000 };
const LOADED = { width: 1500 };
const SCREEN = { width: 1200, height: 800 };

describe('the finer part to load', () => {
  test('is none if the loaded level is fine enough', () => {
    assert.equal(visiblePart(PHOTO, LOADED, { scale: 1.4, x: 0.5, y: 0.5 }, SCREEN), null);
    assert.equal(visiblePart(PHOTO, PHOTO, { scale: 10, x: 0.5, y: 0.5 }, SCREEN), null);
  });

  test('covers the visible part with a margin', () => {
    for (const [scale, level] of [
      [2.4, 1],
      [5, 0],
      [10, 0],
    ]) {
      for (const [x, y] of [
        [0.5, 0.5],
        [0.1, 0.95],
      ]) {
        const part = visiblePart(PHOTO, LOADED, { scale, x, y }, SCREEN);
        assert.equal(part.level, level, `${scale}`);
        const { rect } = part;
        const half = { x: PHOTO.width / scale / 2, y: (PHOTO.width / scale / 2) * (SCREEN.height / SCREEN.width) };
        const least = [x * PHOTO.width - half.x, y * PHOTO.height - half.y].map((v) => Math.max(0, v));
        const most = [Math.min(PHOTO.width, x * PHOTO.width + half.x), Math.min(PHOTO.height, y * PHOTO.height + half.y)];
        assert.ok(rect.x <= least[0] && rect.y <= least[1], JSON.stringify(part));
        assert.ok(rect.x + rect.w >= most[0] && rect.y + rect.h >= most[1], JSON.stringify(part));
        assert.ok(rect.x + rect.w <= PHOTO.width && rect.y + rect.h <= PHOTO.height && Number.isInteger(rect.x) && rect.w > 0);
        assert.ok((rect.w * rect.h) / 4 ** level < 12e6);
      }
    }
  });

  test('has a URL derived from the container’s', () => {
    const part = { level: 0, rect: { x: 512, y: 0, w: 900, h: 800 } };
    assert.equal(partAddress('/v1/photos/a/atlas?fit=1500&v=7', part), '/v1/photos/a/atlas?v=7&level=0&region=512,0,900,800');
    assert.equal(partAddress('data:application/vnd.tmpi;base64,AAAA', part), null);
  });
});
