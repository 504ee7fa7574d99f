// Full screen on the pages of a photo and of a room: what is then seen on the screen.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, pixelsAt, pixelsOf, shareDifferent, waitForMode } from '../support/browser.mjs';
import { roomSuite } from '../support/room.mjs';
import { boxSuite } from '../support/suite.mjs';

const SCREENS = {
  desktop: { viewport: { width: 1280, height: 800 } },
  'a phone': { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true },
  'a phone on its side': { viewport: { width: 844, height: 390 }, hasTouch: true, isMobile: true },
};
/** The picture has at least this share of the screen's width or height: it fills one of them but for the tools. */
const FILLS = 0.8;

/** Where the picture is, and the screen's size. */
function places(page) {
  return page.evaluate(() => {
    const { x, y, width, height } = document.querySelector('.tmpi-canvas').getBoundingClientRect();
    const tools = document.getElementById('tools').getBoundingClientRect();
    const under = document.elementFromPoint(x + width / 2, y + height / 2)?.id;
    return { x, y, width, height, tools: [tools.width, tools.height], under, screen: [innerWidth, innerHeight] };
  });
}

/** Waits until the picture has its new size. */
async function settled(page) {
  let last = '';
  for (;;) {
    await page.evaluate(() => new Promise((resume) => requestAnimationFrame(() => requestAnimationFrame(resume))));
    const now = JSON.stringify(await places(page));
    if (now === last) return JSON.parse(now);
    last = now;
  }
}

/** Pixels that the screen shows at the picture's place, and the picture's size there. */
async function seen(page, { x, y, width, height }) {
  const clip = { x: Math.ceil(x), y: Math.ceil(y), width: Math.floor(width) - 1, height: Math.floor(height) - 1 };
  const shot = await page.screenshot({ clip, scale: 'css' });
  const { page: blank, context } = await openPage(page.context().browser());
  const pixels = await pixelsOf(blank, `data:image/png;base64,${shot.toString('base64')}`);
  await context.close();
  return { pixels, width: clip.width, height: clip.height };
}

/** Asserts that the picture fills the screen, and nothing lies over it. */
async function assertFills(page) {
  const at = await settled(page);
  const [width, height] = at.screen;
  const told = JSON.stringify(at);
  assert.ok(at.x >= 0 && at.y >= 0 && at.x + at.width <= width && at.y + at.height <= height, `on the screen: ${told}`);
  assert.ok(Math.max(at.width / width, at.height / height) >= FILLS, `as large as fits: ${told}`);
  assert.ok(Math.min(at.tools[0] / width, at.tools[1] / height) < 0.25, `the tools keep their size: ${told}`);
  assert.equal(at.under, 'stage', told);
  return at;
}

/** Goes to full screen in one way. */
async function enter(page, way) {
  if (way === 'the button') await page.locator('#fullscreen').click();
  else await page.keyboard.press('f');
  await page.waitForFunction(() => document.fullscreenElement === document.documentElement);
}

describe('full screen of a photo', () => {
  const suite = boxSuite();
  for (const [screen, options] of Object.entries(SCREENS)) {
    for (const way of screen === 'desktop' ? ['the button', 'the key F'] : ['the button']) {
      test(`by ${way} on ${screen} shows the photo`, async () => {
        // a browser that knows the hints shows nothing over the photo
        const localStorage = [{ name: 'tmpi-hinted', value: '1' }];
        const storageState = { cookies: [], origins: [{ origin: suite.server.url, localStorage }] };
        const { page, context, errors } = await suite.open({ reducedMotion: 'reduce', storageState, ...options });
        await waitForMode(page, 'gpu');
        await enter(page, way);
        const shot = await seen(page, await assertFills(page));
        // shown where the photo itself is, from where it was taken
        const own = await pixelsAt(page, {}, shot.width, shot.height);
        const off = shareDifferent(shot.pixels, own, shot.width, shot.height, { levels: 24 });
        assert.ok(off < 0.05, `${off} of the pixels differ`);
        await page.keyboard.press('f');
        await page.waitForFunction(() => !document.fullscreenElement);
        await assertFills(page);
        assert.deepEqual(errors, []);
        await context.close();
      });
    }
  }
});

describe('full screen of a room', () => {
  const suite = roomSuite();
  test('shows the picture on every screen', async () => {
    const publisher = await suite.publish('wide');
    for (const [screen, options] of Object.entries(SCREENS)) {
      const { page, context } = await suite.watch('wide', { options: { reducedMotion: 'reduce', ...options } });
      await page.waitForFunction(() => document.getElementById('stage').dataset.mode && document.getElementById('loading').hidden);
      await enter(page, 'the button');
      const shot = await seen(page, await assertFills(page));
      const levels = new Set(shot.pixels.filter((_, i) => i % 4 === 0));
      assert.ok(levels.size > 32, `a picture on ${screen}, not one colour: ${levels.size} levels`);
      await context.close();
    }
    await publisher.context.close();
  });
});
