// GPUs with a small maximum texture size.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { fractionDifferent, openPage, pixelsAt, waitForMode } from '../support/browser.mjs';
import { boxSuite, HEIGHT, WIDTH } from '../support/suite.mjs';

const SIDE = 128;

/** Fakes the maximum texture size. */
function limitTextures(side) {
  const { getParameter } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.getParameter = function (name) {
    return name === this.MAX_TEXTURE_SIZE ? side : getParameter.call(this, name);
  };
}

for (const [mode, webgpu] of [
  ['webgl', false],
  // WebGPU also packs small, so that the scene fits if it falls back to WebGL
  ['gpu', true],
]) {
  describe(`small textures, ${mode}`, () => {
    const suite = boxSuite({ webgpu });

    test('the scene fits into smaller pages and looks the same', async () => {
      const seen = [];
      for (const small of [false, true]) {
        const { page, context } = await openPage(suite.browser);
        if (small) await page.addInitScript(limitTextures, SIDE);
        await page.goto(`${suite.server.url}/view/box`);
        await waitForMode(page, mode);
        const { width, height, pages } = await page.evaluate(() => window.viewer.scene.atlas);
        assert.equal(Math.max(width, height) <= SIDE && pages > 1, small, `${pages} pages of ${width} × ${height}`);
        seen.push(await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT));
        await context.close();
      }
      // other positions in the texture round differently
      assert.equal(fractionDifferent(...seen, WIDTH, HEIGHT, { levels: 2 }), 0);
    });
  });
}
