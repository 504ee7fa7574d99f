// Pictures that a page was sent and does not show yet.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { UnderWay } from '../../../static/live/under-way.js';

const INTERVAL = 33;

/** To a page that shows what it is sent after so many ms, ten pictures were sent. */
function page(ms) {
  const underWay = new UnderWay();
  for (let frame = 0; frame < 10; frame++) {
    underWay.sent({ frame, time: frame }, frame * 100);
    underWay.shown(frame * 100 + ms);
  }
  return underWay;
}

describe('a page', () => {
  test('that is quick has two pictures at a time, and tells of the first one first', () => {
    const underWay = page(20);
    assert.ok(underWay.free(INTERVAL));
    for (const frame of [10, 11]) {
      assert.ok(underWay.free(INTERVAL), `${frame}`);
      underWay.sent({ frame, time: frame }, 1000);
    }
    assert.ok(!underWay.free(INTERVAL));
    assert.equal(underWay.shown(1020)?.frame, 10);
    assert.ok(underWay.free(INTERVAL) && !underWay.empty);
    assert.equal(underWay.shown(1030)?.frame, 11);
    assert.equal(underWay.shown(1040), null);
  });

  test('that is slow, or of which nothing is known, has one', () => {
    for (const underWay of [page(90), new UnderWay()]) {
      assert.ok(underWay.free(INTERVAL));
      underWay.sent({ frame: 10, time: 0 }, 1000);
      assert.ok(!underWay.free(INTERVAL));
    }
  });

  test('that begins anew has that alone, and how long it took counts for nothing', () => {
    const underWay = page(20);
    underWay.sent({ frame: 10, time: 0 }, 1000, true);
    assert.ok(!underWay.free(INTERVAL));
    underWay.shown(1900);
    underWay.sent({ frame: 11, time: 0 }, 1900);
    assert.ok(underWay.free(INTERVAL));
  });

  test('that forgot what it was sent can be sent more, and says how long it has been silent', () => {
    const underWay = page(20);
    assert.equal(underWay.age(5000), 0);
    underWay.sent({ frame: 10, time: 0 }, 1000);
    assert.equal(underWay.age(1500), 500);
    underWay.clear();
    assert.ok(underWay.free(INTERVAL) && underWay.age(1500) === 0);
  });
});
