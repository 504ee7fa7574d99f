// How evenly frames are shown that come unevenly, and what that costs.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Jitter } from '../../../static/live/jitter.js';
import { PlayOut } from '../../../static/live/play-out.js';

const INTERVAL = 1000 / 30;
/** Less is not seen. */
const REFRESH = 1000 / 60;
/** A network that is as bad each time. */
const random = (seed) => () => {
  seed = (Math.imul(seed, 1_664_525) + 1_013_904_223) >>> 0;
  return seed / 2 ** 32;
};

/** What becomes of frames that were taken each 33 ms for some seconds: `late` tells how late each comes, `clock` what the publisher's shows. */
function play(seconds, late, { clock = (taken) => taken } = {}) {
  const jitter = new Jitter();
  const frames = [];
  let [came, shown] = [0, 0];
  for (let taken = 0; taken < seconds * 1000; taken += INTERVAL) {
    // in order, as a socket gives them
    came = Math.max(came, taken + 5 + late(taken));
    const due = jitter.arrived(clock(taken), came);
    shown = Math.max(shown, came, due);
    frames.push({ taken, came, shown, added: shown - came, delay: jitter.delay });
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
  test('are not held on a calm line', () => {
    const noise = random(1);
    const frames = play(60, () => 8 * noise());
    assert.equal(most(frames, 'added'), 0);
  });

  test('that come in bursts are shown evenly', (t) => {
    // four at a time
    const frames = after(
      play(30, (taken) => (3 - (Math.round(taken / INTERVAL) % 4)) * INTERVAL),
      5,
    );
    const [before, now] = [unevenness(frames, 'came'), unevenness(frames, 'shown')];
    t.diagnostic(`${before.toFixed(1)} ms before, ${now.toFixed(1)} ms now, ${mean(frames, 'added').toFixed(1)} ms added`);
    assert.ok(before > 40 && now < REFRESH, `${before}, ${now}`);
    assert.ok(most(frames, 'added') <= 3 * INTERVAL + 1, `${most(frames, 'added')}`);
  });

  test('that come at random are shown far more evenly, at a price that is bound', (t) => {
    for (const scale of [15, 40, 400]) {
      const noise = random(scale);
      const frames = after(
        play(60, () => -scale * Math.log(1 - noise())),
        5,
      );
      const [before, now] = [unevenness(frames, 'came'), unevenness(frames, 'shown')];
      t.diagnostic(`${scale} ms: ${before.toFixed(1)} ms before, ${now.toFixed(1)} ms now, ${mean(frames, 'added').toFixed(1)} ms added`);
      assert.ok(most(frames, 'delay') <= 200);
      if (scale < 100) assert.ok(now < 0.6 * before, `${scale}: ${before}, ${now}`);
    }
  });

  test('are held no longer once the line is calm again', () => {
    const frames = play(30, (taken) => (taken < 10_000 ? (3 - (Math.round(taken / INTERVAL) % 4)) * INTERVAL : 0));
    assert.ok(most(after(frames, 8).slice(0, 30), 'delay') > 60);
    assert.equal(most(after(frames, 20), 'added'), 0);
    // it falls too slowly to be seen
    const steps = frames.slice(1).map(({ delay }, i) => frames[i].delay - delay);
    assert.ok(Math.max(...steps) <= 1);
  });

  test('wait for nothing where two clocks drift apart', () => {
    for (const rate of [1 - 2e-4, 1 + 2e-4]) {
      const frames = play(300, () => 0, { clock: (taken) => taken * rate });
      assert.equal(most(frames, 'added'), 0);
    }
  });

  test('that come after a pause are shown at once, and a pause is no jitter', () => {
    // nothing for a second, then all of it
    const frames = play(30, (taken) => (taken > 10_000 && taken < 11_000 ? 11_000 - taken : 0));
    const caught = frames.filter(({ taken }) => taken > 10_000 && taken < 10_700);
    assert.equal(most(caught, 'added'), 0);
    assert.ok(most(frames, 'added') <= 200);
    assert.equal(most(after(frames, 20), 'added'), 0);
  });

  test('go on where a clock was set', () => {
    for (const by of [-3_600_000, -800, 800, 3_600_000]) {
      const frames = play(40, () => 0, { clock: (taken) => taken + (taken > 10_000 ? by : 0) });
      assert.ok(most(frames, 'added') <= 200, `${by}: ${most(frames, 'added')}`);
      assert.ok(most(after(frames, 20), 'added') < 1e-6, `${by}`);
    }
  });
});

describe('what is held', () => {
  test('comes in order, when it is due, and what is behind it with it', async () => {
    const released = [];
    let ended;
    const promise = new Promise((resolve) => {
      ended = resolve;
    });
    const playOut = new PlayOut((item) => {
      released.push(item);
      if (item === 'end') ended(performance.now());
    });
    const start = performance.now();
    playOut.push('late', start - 100);
    playOut.push('now');
    assert.deepEqual(released, ['late', 'now']);
    playOut.push('first', start + 30);
    playOut.push('tiles');
    playOut.push('second', start + 10);
    playOut.push('end', start + 40);
    assert.ok(!playOut.empty);
    assert.deepEqual(released, ['late', 'now']);
    assert.ok((await promise) >= start + 40);
    assert.deepEqual(released, ['late', 'now', 'first', 'tiles', 'second', 'end']);
    assert.ok(playOut.empty);
  });

  test('is forgotten where that is said, and is never much', () => {
    const released = [];
    const playOut = new PlayOut((item) => released.push(item));
    const far = performance.now() + 60_000;
    for (let i = 0; i < 300; i++) playOut.push(i, far);
    assert.deepEqual(
      released,
      Array.from({ length: 44 }, (_, i) => i),
    );
    playOut.clear();
    assert.ok(playOut.empty);
    playOut.push('next');
    assert.equal(released.at(-1), 'next');
  });

  test('is released at once as far as it is needed, where nobody looks any more', () => {
    const released = [];
    const playOut = new PlayOut((item) => released.push(item));
    const far = performance.now() + 60_000;
    playOut.push('frame', far);
    playOut.push('tiles', 0, true);
    playOut.push('another', far);
    playOut.push('more tiles', 0, true);
    assert.deepEqual(released, []);
    playOut.hurry();
    assert.deepEqual(released, ['tiles', 'more tiles']);
    assert.ok(playOut.empty);
  });
});
