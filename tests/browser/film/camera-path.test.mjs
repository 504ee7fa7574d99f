// Camera paths of films.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { cameraAt, pathAt, STYLES } from '../../../static/film/camera-path.js';
import { planOf } from '../../../static/film/plan.js';
import { extrinsics } from '../../../static/view/camera.js';

const head = { width: 400, height: 300, intrinsics: { fx: 500, fy: 500, cx: 200, cy: 150 } };
const scene = { head, limits: { x: 0.06, y: 0.04, z: 0.1 }, pivot: 0.4 };
const size = { width: 200, height: 150 };

describe('camera paths', () => {
  test('return to their start, stay within limits, and move', () => {
    for (const style of STYLES) {
      const places = Array.from({ length: 65 }, (_, i) => pathAt(style, i / 64));
      assert.deepEqual(JSON.stringify(places[64], round), JSON.stringify(places[0], round), style);
      for (const { place } of places) for (const v of Object.values(place)) assert.ok(Math.abs(v) <= 1, `${style}: ${v}`);
      const far = Math.max(
        ...places.map((p) => Math.hypot(p.place.x - places[0].place.x, p.place.y - places[0].place.y, p.place.z - places[0].place.z)),
      );
      assert.ok(far > 0.5, `${style}: ${far}`);
    }
    assert.throws(() => pathAt('spiral', 0), /spiral/);
  });

  test('all differ', () => {
    const views = STYLES.map((style) => Array.from({ length: 8 }, (_, i) => cameraAt(scene, pathAt(style, i / 8), size)));
    assert.equal(new Set(views.map((way) => JSON.stringify(way, round))).size, STYLES.length);
  });

  test('a dolly zoom keeps the size at the pivot', () => {
    for (const share of [0, 0.25, 0.5]) {
      const { pose, k } = cameraAt(scene, pathAt('dolly-zoom', share), size);
      // size at the pivot's disparity is focal length / distance from the camera
      const large = k.fx / (1 / scene.pivot - pose.tz);
      const { k: still } = cameraAt(scene, pathAt('dolly-zoom', 0), size);
      assert.ok(Math.abs(large / (still.fx * scene.pivot) - 1) < 1e-9, `${share}`);
    }
    assert.ok(cameraAt(scene, pathAt('dolly-zoom', 0.5), size).pose.tz < -0.05);
  });

  test('films crop the border symmetrically', () => {
    const { k } = cameraAt(scene, pathAt('swing', 0), size);
    assert.ok(k.fx > 250 && k.fx < 270, `${k.fx}`);
    assert.deepEqual([k.cx, k.cy], [100, 75]);
    // a picture slightly taller than the photo shows nothing beyond it
    const higher = cameraAt(scene, pathAt('swing', 0), { width: 200, height: 152 });
    assert.ok((152 / 2) * (500 / higher.k.fy) < 150);
  });

  test('films show nothing from beyond the border where the photo moves as usual', () => {
    const usual = { ...scene, limits: { x: 0.04, y: 0.03, z: 0.04 } };
    const { width, height, intrinsics } = head;
    for (const style of ['swing', 'orbit', 'wiggle']) {
      for (let i = 0; i < 16; i++) {
        const { pose, k } = cameraAt(usual, pathAt(style, i / 16), size);
        const { r, t } = extrinsics(pose);
        for (const [right, lower, delta] of [0, 1, 2, 3, 4, 5, 6, 7].map((bits) => [bits & 1, (bits >> 1) & 1, bits >> 2])) {
          const q = [(right * width - intrinsics.cx) / intrinsics.fx, (lower * height - intrinsics.cy) / intrinsics.fy, 1];
          const p = [0, 3, 6].map((row, axis) => r[row] * q[0] + r[row + 1] * q[1] + r[row + 2] * q[2] + t[axis] * delta);
          const [x, y] = [(k.fx * p[0]) / p[2] + k.cx, (k.fy * p[1]) / p[2] + k.cy];
          const beyond = Math.max(right ? size.width - x : x, lower ? size.height - y : y);
          assert.ok(beyond <= 0, `${style} ${i}: corner ${right}, ${lower} at ${delta} is ${beyond} px inside`);
        }
      }
    }
  });

  test('film sizes follow the photo, even numbers for video', () => {
    const options = { kind: 'mp4', style: 'swing', seconds: 4, side: 1280 };
    const plan = planOf(options, { width: 3001, height: 2003 });
    assert.deepEqual([plan.width, plan.height, plan.times.length, plan.turns], [1280, 854, 120, 1]);
    const small = planOf(options, { width: 201, height: 101 });
    assert.deepEqual([small.width % 2, small.height % 2], [0, 0]);
    assert.ok(small.width <= 202 && small.height <= 102);
    assert.deepEqual(planOf({ ...options, kind: 'gif' }, { width: 201, height: 101 }).width, 201);
  });

  test('GIF, film and wigglegram have the right lengths', () => {
    const photo = { width: 400, height: 300 };
    const gif = planOf({ kind: 'gif', style: 'orbit', seconds: 8, side: 480 }, photo);
    assert.equal(gif.turns, 1);
    assert.ok(Math.abs(gif.times.length * gif.frameMs - 4000) < gif.frameMs);
    const film = planOf({ kind: 'mp4', style: 'orbit', seconds: 8, side: 480 }, photo);
    assert.deepEqual([film.turns, film.times.length], [2, 240]);
    const wiggle = planOf({ kind: 'gif', style: 'wiggle', seconds: 8, side: 480 }, photo);
    assert.deepEqual([wiggle.times.length, wiggle.frameMs], [4, 120]);
    const places = wiggle.times.map((t) => pathAt('wiggle', t).place.x);
    assert.deepEqual(places, [-0.8, 0, 0.8, 0]);
    const long = planOf({ kind: 'mp4', style: 'wiggle', seconds: 2, side: 480 }, photo);
    assert.equal(long.times.length, 16);
  });
});

/** JSON replacer that rounds numbers. */
function round(_, v) {
  return typeof v === 'number' ? Math.round(v * 1e9) / 1e9 + 0 : v;
}
