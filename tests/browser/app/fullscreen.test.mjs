// Full screen on the pages of photos and rooms.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { filePixels, fractionDifferent, pixelsAt, waitForMode } from '../support/browser.mjs';
import { roomSuite } from '../support/room.mjs';
import { boxSuite } from '../support/suite.mjs';

const SCREENS = {
  desktop: { viewport: { width: 960, height: 600 } },
  'a phone': { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true },
  'a phone in landscape': { viewport: { width: 844, height: 390 }, hasTouch: true, isMobile: true },
};
/** The picture fills at least this fraction of the screen's width or height; the toolbar takes the rest. */
const FILLS = 0.8;

/** Position of picture and toolbar, and size of the screen. */
function layout(page) {
  return page.evaluate(() => {
    const { x, y, width, height } = document.querySelector('.tmpi-canvas').getBoundingClientRect();
    const tools = document.getElementById('tools').getBoundingClientRect();
    const under = document.elementFromPoint(x + width / 2, y + height / 2)?.id;
    return { x, y, width, height, tools: [tools.width, tools.height], under, screen: [innerWidth, innerHeight] };
  });
}

/** Waits until the layout is stable. */
async function stableLayout(page) {
  let last = '';
  for (;;) {
    await page.evaluate(() => new Promise((resume) => requestAnimationFrame(() => requestAnimationFrame(resume))));
    const now = JSON.stringify(await layout(page));
    if (now === last) return JSON.parse(now);
    last = now;
  }
}

/** Pixels of the picture on the screen, and its size there. */
async function screenPixels(page, { x, y, width, height }) {
  const clip = { x: Math.ceil(x), y: Math.ceil(y), width: Math.floor(width) - 1, height: Math.floor(height) - 1 };
  const shot = await page.screenshot({ clip, scale: 'css' });
  return { pixels: await filePixels(page, shot), width: clip.width, height: clip.height };
}

/** Asserts that the picture fills the screen and nothing covers it. */
async function assertFills(page) {
  const at = await stableLayout(page);
  const [width, height] = at.screen;
  const details = JSON.stringify(at);
  assert.ok(at.x >= 0 && at.y >= 0 && at.x + at.width <= width && at.y + at.height <= height, `the picture is on the screen: ${details}`);
  assert.ok(Math.max(at.width / width, at.height / height) >= FILLS, `the picture fills the screen: ${details}`);
  assert.ok(Math.min(at.tools[0] / width, at.tools[1] / height) < 0.25, `the toolbar keeps its size: ${details}`);
  assert.equal(at.under, 'stage', details);
  return at;
}

/** Enters full screen by the button or the key. */
async function enter(page, trigger) {
  if (trigger === 'the button') await page.locator('#fullscreen').click();
  else await page.keyboard.press('f');
  await page.waitForFunction(() => document.fullscreenElement === document.documentElement);
}

describe('full screen of a photo', () => {
  const suite = boxSuite();
  for (const [screen, options] of Object.entries(SCREENS)) {
    test(`shows the photo on ${screen}`, async () => {
      // hides the hint of a first visit, which covers the photo
      const localStorage = [{ name: 'tmpi-hinted', value: '1' }];
      const storageState = { cookies: [], origins: [{ origin: suite.server.url, localStorage }] };
      const { page, context, errors } = await suite.open({ storageState, ...options });
      await waitForMode(page, 'gpu');
      for (const trigger of screen === 'desktop' ? ['the button', 'the key F'] : ['the button']) {
        await enter(page, trigger);
        const shot = await screenPixels(page, await assertFills(page));
        // the screen shows the photo from the reference camera
        const expected = await pixelsAt(page, {}, shot.width, shot.height);
        const off = fractionDifferent(shot.pixels, expected, shot.width, shot.height, { levels: 24 });
        assert.ok(off < 0.05, `by ${trigger}: ${off} of the pixels differ`);
        await page.keyboard.press('f');
        await page.waitForFunction(() => !document.fullscreenElement);
        await assertFills(page);
      }
      assert.deepEqual(errors, []);
      await context.close();
    });
  }
});

describe('full screen of a room', () => {
  const suite = roomSuite();
  test('shows the picture on every screen', async () => {
    const publisher = await suite.publish('wide');
    for (const [screen, options] of Object.entries(SCREENS)) {
      const { page, context } = await suite.watch('wide', { options });
      await page.waitForFunction(() => document.getElementById('stage').dataset.mode && document.getElementById('loading').hidden);
      await enter(page, 'the button');
      const shot = await screenPixels(page, await assertFills(page));
      const levels = new Set(shot.pixels.filter((_, i) => i % 4 === 0));
      assert.ok(levels.size > 32, `the picture on ${screen} is not one colour: ${levels.size} levels`);
      await context.close();
    }
    await publisher.context.close();
  });
});
