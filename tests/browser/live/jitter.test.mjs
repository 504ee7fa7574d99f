// How evenly the playout buffer shows jittery frames, and at what delay.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Jitter } from '../../../static/live/jitter.js';
import { PlayoutBuffer } from '../../../static/live/playout-buffer.js';

const INTERVAL = 1000 / 30;
/** Users do not notice less unevenness. */
const REFRESH = 1000 / 60;
/** Reproducible random numbers. */
const random = (seed) => () => {
  seed = (Math.imul(seed, 1_664_525) + 1_013_904_223) >>> 0;
  return seed / 2 ** 32;
};

/** Simulates frames taken every 33 ms: `late` returns each frame's network delay, `clock` the publisher's time. */
function play(seconds, late, { clock = (taken) => taken } = {}) {
  const jitter = new Jitter();
  const frames = [];
  let [arrived, shown] = [0, 0];
  for (let taken = 0; taken < seconds * 1000; taken += INTERVAL) {
    // a socket delivers in order
    arrived = Math.max(arrived, taken + 5 + late(taken));
    const due = jitter.arrived(clock(taken), arrived);
    shown = Math.max(shown, arrived, due);
    frames.push({ taken, arrived, shown, added: shown - arrived, delay: jitter.delay });
  }
  return frames;
}

/** Standard deviation of the times between frames. */
function unevenness(frames, when) {
  const steps = frames.slice(1).map((frame, i) => frame[when] - frames[i][when]);
  const mean = steps.reduce((sum, v) => sum + v, 0) / steps.length;
  return Math.sqrt(steps.reduce((sum, v) => sum + (v - mean) ** 2, 0) / steps.length);
}

const most = (frames, key) => Math.max(...frames.map((frame) => frame[key]));
const mean = (frames, key) => frames.reduce((sum, frame) => sum + frame[key], 0) / frames.length;
const after = (frames, seconds) => frames.filter(({ taken }) => taken >= seconds * 1000);

describe('frames', () => {
  test('are not delayed on a calm network', () => {
    const noise = random(1);
    const frames = play(60, () => 8 * noise());
    assert.equal(most(frames, 'added'), 0);
  });

  test('that arrive in bursts are shown evenly', (t) => {
    // four at a time
    const frames = after(
      play(30, (taken) => (3 - (Math.round(taken / INTERVAL) % 4)) * INTERVAL),
      5,
    );
    const [before, now] = [unevenness(frames, 'arrived'), unevenness(frames, 'shown')];
    t.diagnostic(`${before.toFixed(1)} ms before, ${now.toFixed(1)} ms now, ${mean(frames, 'added').toFixed(1)} ms added`);
    assert.ok(before > 40 && now < REFRESH, `${before}, ${now}`);
    assert.ok(most(frames, 'added') <= 3 * INTERVAL + 1, `${most(frames, 'added')}`);
  });

  test('with random jitter are smoothed at bounded delay', (t) => {
    for (const scale of [15, 40, 400]) {
      const noise = random(scale);
      const frames = after(
        play(60, () => -scale * Math.log(1 - noise())),
        5,
      );
      const [before, now] = [unevenness(frames, 'arrived'), unevenness(frames, 'shown')];
      t.diagnostic(`${scale} ms: ${before.toFixed(1)} ms before, ${now.toFixed(1)} ms now, ${mean(frames, 'added').toFixed(1)} ms added`);
      assert.ok(most(frames, 'delay') <= 200);
      if (scale < 100) assert.ok(now < 0.6 * before, `${scale}: ${before}, ${now}`);
    }
  });

  test('are not delayed once the network is calm again', () => {
    const frames = play(30, (taken) => (taken < 10_000 ? (3 - (Math.round(taken / INTERVAL) % 4)) * INTERVAL : 0));
    assert.ok(most(after(frames, 8).slice(0, 30), 'delay') > 60);
    assert.equal(most(after(frames, 20), 'added'), 0);
    // the delay falls too slowly to notice
    const steps = frames.slice(1).map(({ delay }, i) => frames[i].delay - delay);
    assert.ok(Math.max(...steps) <= 1);
  });

  test('are not delayed by clock drift', () => {
    for (const rate of [1 - 2e-4, 1 + 2e-4]) {
      const frames = play(300, () => 0, { clock: (taken) => taken * rate });
      assert.equal(most(frames, 'added'), 0);
    }
  });

  test('after a pause are shown at once', () => {
    // a pause of one second, then all frames at once
    const frames = play(30, (taken) => (taken > 10_000 && taken < 11_000 ? 11_000 - taken : 0));
    const caught = frames.filter(({ taken }) => taken > 10_000 && taken < 10_700);
    assert.equal(most(caught, 'added'), 0);
    assert.ok(most(frames, 'added') <= 200);
    assert.equal(most(after(frames, 20), 'added'), 0);
  });

  test('continue after a clock change', () => {
    for (const by of [-3_600_000, -800, 800, 3_600_000]) {
      const frames = play(40, () => 0, { clock: (taken) => taken + (taken > 10_000 ? by : 0) });
      assert.ok(most(frames, 'added') <= 200, `${by}: ${most(frames, 'added')}`);
      assert.ok(most(after(frames, 20), 'added') < 1e-6, `${by}`);
    }
  });
});

describe('the playout buffer', () => {
  test('releases items in order when they are due', async () => {
    const released = [];
    let ended;
    const promise = new Promise((resolve) => {
      ended = resolve;
    });
    const buffer = new PlayoutBuffer((item) => {
      released.push(item);
      if (item === 'end') ended(performance.now());
    });
    const start = performance.now();
    buffer.push('late', start - 100);
    buffer.push('now');
    assert.deepEqual(released, ['late', 'now']);
    buffer.push('first', start + 30);
    buffer.push('tiles');
    buffer.push('second', start + 10);
    buffer.push('end', start + 40);
    assert.ok(!buffer.empty);
    assert.deepEqual(released, ['late', 'now']);
    assert.ok((await promise) >= start + 40);
    assert.deepEqual(released, ['late', 'now', 'first', 'tiles', 'second', 'end']);
    assert.ok(buffer.empty);
  });

  test('has a maximum size and can be cleared', () => {
    const released = [];
    const buffer = new PlayoutBuffer((item) => released.push(item));
    const far = performance.now() + 60_000;
    for (let i = 0; i < 300; i++) buffer.push(i, far);
    assert.deepEqual(
      released,
      Array.from({ length: 44 }, (_, i) => i),
    );
    buffer.clear();
    assert.ok(buffer.empty);
    buffer.push('next');
    assert.equal(released.at(-1), 'next');
  });

  test('flush releases only the necessary items', () => {
    const released = [];
    const buffer = new PlayoutBuffer((item) => released.push(item));
    const far = performance.now() + 60_000;
    buffer.push('frame', far);
    buffer.push('tiles', 0, true);
    buffer.push('another', far);
    buffer.push('more tiles', 0, true);
    assert.deepEqual(released, []);
    buffer.flush();
    assert.deepEqual(released, ['tiles', 'more tiles']);
    assert.ok(buffer.empty);
  });
});
