// Keys, drags, and idle motion.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Motion, STYLES } from '../../../static/input/camera-motion.js';
import { MOTION, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { waitForStill } from '../support/until.mjs';

/** Simulates `seconds` of motion; returns the state at each frame. */
function simulate(motion, seconds) {
  const places = [];
  for (let i = 0; i < seconds * 60; i++) {
    motion.step(1 / 60);
    places.push({ ...motion.now, magnified: motion.magnified, compensated: motion.compensated, away: motion.away });
  }
  return places;
}

describe('idle motion', () => {
  for (const [style, axes] of Object.entries({ swing: 'xy', orbit: 'xy', dolly: 'z', 'dolly-zoom': 'z', zoom: 'z' })) {
    test(`${style} moves along ${axes} within the limits`, () => {
      const motion = new Motion();
      motion.setIdleStyle(style, 1);
      motion.setIdle(true);
      const places = simulate(motion, 24);
      for (const axis of ['x', 'y', 'z']) {
        const most = Math.max(...places.map((place) => Math.abs(place[axis])));
        assert.ok(axes.includes(axis) ? most > 0.2 && most <= 1 : most === 0, `${axis}: ${most}`);
      }
      const late = places.slice(-8 * 60);
      assert.equal(Math.max(...late.map(({ magnified }) => magnified)) > 1.2, style === 'zoom');
      assert.equal(late.at(-1).compensated, style === 'dolly-zoom' ? 1 : 0);
      assert.ok(late.at(-1).away > 0.99, 'the frame zooms in a little');
      motion.setIdle(false);
      const { x, y, z, away } = simulate(motion, 6).at(-1);
      assert.deepEqual({ x, y, z, away }, { x: 0, y: 0, z: 0, away: 0 }, 'it returns to the photo');
    });
  }

  test('unknown styles fall back, and speed is bounded', () => {
    const motion = new Motion();
    motion.setIdleStyle('spiral', 100);
    assert.deepEqual([motion.style, motion.rate], [STYLES[0], 4]);
    const turns = (rate) => {
      const fast = new Motion();
      fast.setIdleStyle('dolly', rate);
      fast.setIdle(true);
      const places = simulate(fast, 30).map(({ z }) => z);
      return places.filter((z, i) => i > 0 && z > 0 && places[i - 1] <= 0).length;
    };
    assert.ok(turns(2) >= 2 * turns(1) - 1 && turns(2) > turns(1), `${turns(2)} ${turns(1)}`);
  });
});

describe('motion', () => {
  const suite = boxSuite();

  test('keys, drag and buttons move the camera within limits', async () => {
    const { page, context, errors } = await suite.open();
    await waitForMode(page, 'gpu');
    // input takes time to reach the page, so wait for its effect
    const waitForPose = async (what, key, least, most) => {
      const isThere = ({ pose }, [k, from, to]) => pose[k] >= from && pose[k] <= to;
      await waitForStill(page, { when: isThere, given: [key, least, most] }).catch(async () => {
        assert.fail(`${what}: ${JSON.stringify(await page.evaluate(() => window.viewer.pose))}`);
      });
    };
    await page.locator('#stage').focus();
    for (let i = 0; i < 3; i++) await page.keyboard.press('ArrowRight');
    await waitForPose('three steps to the right', 'tx', 0.01, 0.027);
    for (let i = 0; i < 30; i++) await page.keyboard.press('ArrowRight');
    await waitForPose('the limit', 'tx', 0.027, 0.03);
    await page.keyboard.press('0');
    await waitForPose('back', 'tx', 0, 0);
    const box = await page.locator('#stage').boundingBox();
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.down();
    await page.mouse.move(box.x + box.width / 2 + 150, box.y + box.height / 2, { steps: 5 });
    await page.mouse.up();
    await waitForPose('near things follow the pointer', 'tx', -0.03, -0.005);
    await page.locator('#reset').click();
    await waitForPose('reset', 'tx', -1e-4, 1e-4);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('moves by itself, but not with reduced motion', async () => {
    const open = async (options) => {
      const { page, context } = await suite.open(options);
      await waitForMode(page, 'gpu');
      const pressed = () => page.locator('#idle').getAttribute('aria-pressed');
      const distance = () => page.evaluate(() => Math.hypot(window.viewer.pose.tx, window.viewer.pose.ty));
      const toggled = async () => {
        await page.locator('#stage').focus();
        await page.keyboard.press(' ');
        return pressed();
      };
      return { page, context, pressed, distance, toggled };
    };
    const calm = await open();
    const usual = await open(MOTION);
    assert.equal(await usual.pressed(), 'true');
    await usual.page.waitForFunction(() => Math.abs(window.viewer.pose.tx) > 0.01);
    assert.deepEqual([await calm.pressed(), await calm.distance()], ['false', 0], 'it had more time to move');
    assert.deepEqual([await usual.toggled(), await calm.toggled()], ['false', 'true']);
    await calm.page.waitForFunction(() => Math.abs(window.viewer.pose.tx) > 0.01);
    for (const { context } of [usual, calm]) await context.close();
  });
});
