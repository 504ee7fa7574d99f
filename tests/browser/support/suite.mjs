// What most suites need: a server with one photo, a browser, and pages in it.
import { after, before } from 'node:test';
import { launch, openPage } from './browser.mjs';
import { boxContainer } from './container.mjs';
import { serve } from './static-server.mjs';

/** Size of the box's photo. */
export const [WIDTH, HEIGHT] = [200, 120];
/** The least motion, so that a picture is at rest when nobody moves it. */
export const STILL = { reducedMotion: 'reduce' };

/**
 * The box's photo on a server, and a browser; to be called in `describe`.
 * @param {{webgpu?: boolean, width?: number, height?: number, wasm?: boolean, atlas?: Buffer}} [options] `wasm`: whether the policy allows
 *   WebAssembly; `atlas`: another container
 */
export function boxSuite({ webgpu = true, width = WIDTH, height = HEIGHT, wasm = true, atlas } = {}) {
  const suite = {
    server: null,
    browser: null,
    /** Opens the photo's page. */
    async open(options = STILL, hash = '') {
      const opened = await openPage(suite.browser, options);
      await opened.page.goto(`${suite.server.url}/view/box${hash}`);
      return opened;
    },
  };
  before(async () => {
    suite.server = await serve({ atlas: atlas ?? boxContainer(width, height), wasm });
    suite.browser = await launch({ webgpu });
  });
  after(async () => {
    await suite.browser?.close();
    await suite.server?.close();
  });
  return suite;
}
