// Photos and depth maps told apart by their names; where depth comes from, in words.
import assert from 'node:assert/strict';
import { test } from 'node:test';
import { pairs } from '../../../static/app/pairs.js';

// the module looks at the browser's language when it is loaded
Object.defineProperty(globalThis, 'navigator', { value: { language: 'en' }, configurable: true });
const { depthSource } = await import('../../../static/app/depth-source.js');

const named = (...names) => pairs(names.map((name) => new File(['x'], name))).map(({ file, depth }) => [file.name, depth?.name ?? null]);

test('a map goes with its photo, in any order and with any extension', () => {
  assert.deepEqual(named('a_depth.png', 'a.jpg', 'b.jpg'), [
    ['a.jpg', 'a_depth.png'],
    ['b.jpg', null],
  ]);
  for (const map of ['A-Depth.jpg', 'a.depthmap.webp', 'a_depth_map.png', 'a disparity.png', 'a_disp.png'])
    assert.deepEqual(named('a.jpg', map), [['a.jpg', map]], map);
});

test('a name that only looks like a map’s is a photo', () => {
  assert.deepEqual(named('depth.png', 'in-depth.jpg', 'b.jpg'), [
    ['depth.png', null],
    ['in-depth.jpg', null],
    ['b.jpg', null],
  ]);
  assert.deepEqual(named('_depth.png'), [['_depth.png', null]]);
  // the second map of a photo is no photo
  assert.deepEqual(named('a.jpg', 'a_depth.png', 'a-depth.png'), [['a.jpg', 'a_depth.png']]);
});

test('what made the depth is told in words', () => {
  const report = (depth_model, input = {}) => ({ depth_model, input, stages: [{ name: 'depth', ms: 31 }] });
  assert.equal(depthSource(report('tmpi')), 'Depth: estimated by the built-in network in 0.03 s.');
  assert.equal(depthSource(report('depth-anything-v2-small-fp16')), 'Depth: estimated by Depth Anything V2 Small in 0.03 s.');
  assert.equal(depthSource(report('other-net')), 'Depth: estimated by other-net in 0.03 s.');
  assert.equal(depthSource(report('carried', { depth: { stretched: false } })), 'Depth: as the photo brought it along.');
  assert.ok(depthSource(report('given', { depth: { stretched: true } })).includes('stretched'));
  assert.equal(depthSource({}), '');
  assert.ok(depthSource(report('tmpi', { depth_problem: 'it is torn' })).endsWith('it is torn'));
});
