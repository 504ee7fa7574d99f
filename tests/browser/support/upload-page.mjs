// The gallery page with fake server responses.
import { openPage } from './browser.mjs';
import { boxSuite } from './suite.mjs';

/** A photo in the server's list. */
export const photo = (id) => ({ id, state: 'done', created: '2026-03-04T05:06:07Z', width: 30, height: 20, atlas_bytes: 1500 });

/** A server and a browser without WebGPU. Call it in `describe`. */
export function uploadSuite() {
  const suite = boxSuite({ webgpu: false, atlas: Buffer.alloc(0) });
  /** Opens the page; `posts` are the responses to uploads, in order. */
  suite.open = async function open({ pages = [{ photos: [] }], posts = [], options = {} }) {
    const { page, context } = await openPage(suite.browser, options);
    const sent = [];
    const bodies = [];
    await page.route('**/v1/photos*', (route) => {
      if (route.request().method() === 'POST') {
        sent.push(Date.now());
        bodies.push(route.request().postDataBuffer()?.toString('latin1') ?? '');
        return route.fulfill(posts.shift());
      }
      const after = Number(new URL(route.request().url()).searchParams.get('after') ?? 0);
      return route.fulfill({ json: pages[after] });
    });
    await page.route('**/v1/photos/*/events', (route) =>
      route.fulfill({
        contentType: 'text/event-stream',
        body: 'event: stage\ndata: {"stage":"layers","step":3,"steps":4}\n\nevent: done\ndata: {}\n\n',
      }),
    );
    await page.goto(`${suite.server.url}/`);
    return { page, context, sent, bodies };
  };
  return suite;
}
