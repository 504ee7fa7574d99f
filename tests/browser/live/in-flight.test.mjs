// Pictures that are sent to a page and not yet shown.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { InFlight } from '../../../static/live/in-flight.js';

const INTERVAL = 33;

/** State after ten pictures that the page showed after `ms` each. */
function page(ms) {
  const inFlight = new InFlight();
  for (let frame = 0; frame < 10; frame++) {
    inFlight.sent({ frame, time: frame }, frame * 100);
    inFlight.shown(frame * 100 + ms);
  }
  return inFlight;
}

describe('pictures in flight', () => {
  test('a fast page gets two pictures at a time', () => {
    const inFlight = page(20);
    assert.ok(inFlight.canSend(INTERVAL));
    for (const frame of [10, 11]) {
      assert.ok(inFlight.canSend(INTERVAL), `${frame}`);
      inFlight.sent({ frame, time: frame }, 1000);
    }
    assert.ok(!inFlight.canSend(INTERVAL));
    assert.equal(inFlight.shown(1020)?.frame, 10);
    assert.ok(inFlight.canSend(INTERVAL) && !inFlight.empty);
    assert.equal(inFlight.shown(1030)?.frame, 11);
    assert.equal(inFlight.shown(1040), null);
  });

  test('a slow or new page gets one', () => {
    for (const inFlight of [page(90), new InFlight()]) {
      assert.ok(inFlight.canSend(INTERVAL));
      inFlight.sent({ frame: 10, time: 0 }, 1000);
      assert.ok(!inFlight.canSend(INTERVAL));
    }
  });

  test('after a restart one picture is sent, its time ignored', () => {
    const inFlight = page(20);
    inFlight.sent({ frame: 10, time: 0 }, 1000, true);
    assert.ok(!inFlight.canSend(INTERVAL));
    inFlight.shown(1900);
    inFlight.sent({ frame: 11, time: 0 }, 1900);
    assert.ok(inFlight.canSend(INTERVAL));
  });

  test('clear allows new pictures and resets the age', () => {
    const inFlight = page(20);
    assert.equal(inFlight.age(5000), 0);
    inFlight.sent({ frame: 10, time: 0 }, 1000);
    assert.equal(inFlight.age(1500), 500);
    inFlight.clear();
    assert.ok(inFlight.canSend(INTERVAL) && inFlight.age(1500) === 0);
  });
});
