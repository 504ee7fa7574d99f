// Graphics devices whose textures are smaller than the pages that others get.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, pixelsAt, shareDifferent, waitForMode } from '../support/browser.mjs';
import { boxSuite, HEIGHT, STILL, WIDTH } from '../support/suite.mjs';

const SIDE = 128;

/** Makes the page believe that no texture is larger. */
function shrink(side) {
  const { getParameter } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.getParameter = function (name) {
    return name === this.MAX_TEXTURE_SIZE ? side : getParameter.call(this, name);
  };
}

for (const [mode, webgpu] of [
  ['webgl', false],
  // the scene must still fit where WebGPU is lost
  ['gpu', true],
]) {
  describe(`small textures, ${mode}`, () => {
    const suite = boxSuite({ webgpu });

    test('the scene is packed into pages that fit, and looks the same', async () => {
      const seen = [];
      for (const small of [false, true]) {
        const { page, context } = await openPage(suite.browser, STILL);
        if (small) await page.addInitScript(shrink, SIDE);
        await page.goto(`${suite.server.url}/view/box`);
        await waitForMode(page, mode);
        const { width, height, pages } = await page.evaluate(() => window.viewer.scene.atlas);
        assert.equal(Math.max(width, height) <= SIDE && pages > 1, small, `${pages} pages of ${width} × ${height}`);
        seen.push(await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT));
        await context.close();
      }
      // other places on the pages round otherwise
      assert.equal(shareDifferent(...seen, WIDTH, HEIGHT, { levels: 2 }), 0);
    });
  });
}
