// Views that the server draws because the browser cannot.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { disableGraphics, openPage, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { gate, until, waitForAnimationFrames, waitForStill } from '../support/until.mjs';

describe('server views', () => {
  const suite = boxSuite();
  const isShown = ({ serverViews }) => serverViews.shown === serverViews.wanted;

  test('request one view at a time, the latest pose last', async (t) => {
    // a small page, because the test's own process draws the views
    const { page, context, errors } = await openPage(suite.browser, { viewport: { width: 480, height: 460 } });
    await disableGraphics(page, { webgl: false });
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'served');
    assert.match(await page.locator('#served-note').textContent(), /The server draws this view/);
    assert.match(await page.locator('#readout').textContent(), /drawn by the server/);
    await page.locator('#stage').focus();
    await page.waitForFunction(() => window.viewer.serverViews.shown);
    const seen = suite.server.views.length;
    const answer = gate();
    t.after(answer.open);
    suite.server.held.view = answer.opened;
    for (let i = 0; i < 12; i++) await page.keyboard.press('ArrowLeft');
    await waitForStill(page);
    await until(() => suite.server.views.length > seen);
    await waitForAnimationFrames(page, 5);
    assert.equal(suite.server.views.length, seen + 1, 'the page waits for the first view before it requests the second');
    answer.open();
    await waitForStill(page, { when: isShown });
    const last = new URLSearchParams(suite.server.views.at(-1));
    assert.equal(last.get('tx'), '-0.03000');
    assert.ok(Number(last.get('fov')) > 60 && Number(last.get('fov')) < 82, last.get('fov'));
    assert.equal(last.get('crop'), null, 'the whole photo');
    for (let i = 0; i < 4; i++) await page.keyboard.press('+');
    await waitForStill(page, { when: isShown });
    const close = new URLSearchParams(suite.server.views.at(-1));
    const [x, y, w, h] = close.get('crop').split(',').map(Number);
    assert.ok(w < 0.5 && w > 0.3 && h < 0.7 && Math.abs(x + w / 2 - 0.5) < 1e-3 && Math.abs(y + h / 2 - 0.5) < 1e-3, close.get('crop'));
    assert.equal(close.get('fov'), last.get('fov'));
    // the view has the aspect ratio of the visible part
    assert.ok(Math.abs(Number(close.get('w')) / Number(close.get('h')) - (w * 200) / (h * 120)) < 0.02, close.toString());
    assert.deepEqual(errors, []);
    await context.close();
  });
});
