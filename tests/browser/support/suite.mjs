// Shared setup for most suites: a server with one photo, and a browser.
import { after, before } from 'node:test';
import { launch, openPage } from './browser.mjs';
import { boxContainer } from './container.mjs';
import { serve } from './fake-server.mjs';

/** Size of the photo of the box. */
export const [WIDTH, HEIGHT] = [200, 120];

/**
 * A server with the photo of the box, and a browser. Call it in `describe`.
 * @param {{webgpu?: boolean, width?: number, height?: number, wasm?: boolean, atlas?: Buffer}} [options] `wasm`: whether the policy allows
 *   WebAssembly; `atlas`: another container
 */
export function boxSuite({ webgpu = true, width = WIDTH, height = HEIGHT, wasm = true, atlas } = {}) {
  const suite = {
    server: null,
    browser: null,
    /** Opens the photo page. */
    async open(options = {}, hash = '') {
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
