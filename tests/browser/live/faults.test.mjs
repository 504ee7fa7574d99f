// What goes wrong around a room: tiles that do not come, a microphone that fails, a camera that stands still, links and places that are gone.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { flatPixels, likenessOf, roomSuite, showsFrames } from '../support/room.mjs';
import { frames } from '../support/until.mjs';

/** A page whose room's worker is given tiles once the page says `come`. */
const withoutTiles = (page) =>
  page.addInitScript(() => {
    const tiles = new BroadcastChannel('tiles');
    window.come = () => tiles.postMessage('come');
    const { Worker: Plain } = window;
    window.Worker = class extends Plain {
      constructor(url) {
        const script = `const early = []; self.onmessage = (event) => early.push(event);
          let wait = new Promise((come) => (new BroadcastChannel('tiles').onmessage = come)).then(() => (wait = null));
          const isTiles = (data) => [26, 34].includes(new Uint8Array(data)[0]);
          self.WebSocket = class extends WebSocket {
            set onmessage(f) {
              super.onmessage = f && ((event) => {
                if (wait && isTiles(event.data)) wait.then(() => f(event));
                else f(event);
              });
            }
          };
          await import(${JSON.stringify(new URL(url, location.href).href)}); for (const event of early) self.onmessage(event);`;
        super(URL.createObjectURL(new Blob([script], { type: 'text/javascript' })), { type: 'module' });
      }
    };
  });

/** Camera alone, whose frames are held back while `window.still` is set. */
const standing = (page) =>
  page.addInitScript(() => {
    delete window.MediaStreamTrackProcessor;
    const open = navigator.mediaDevices.getUserMedia.bind(navigator.mediaDevices);
    navigator.mediaDevices.getUserMedia = ({ video }) => open({ video });
    const { requestVideoFrameCallback: ask } = HTMLVideoElement.prototype;
    HTMLVideoElement.prototype.requestVideoFrameCallback = function (f) {
      const next = (...args) => (window.still ? ask.call(this, next) : f(...args));
      return ask.call(this, next);
    };
  });

/** Sockets of the page are kept in `window.sockets`. */
const kept = (page) =>
  page.addInitScript(() => {
    window.sockets = [];
    window.WebSocket = class extends WebSocket {
      constructor(...args) {
        super(...args);
        window.sockets.push(this);
      }
    };
  });

describe('around a room', () => {
  const suite = roomSuite();
  const state = (page, wanted, timeout = 20_000) => page.waitForFunction((s) => document.body.dataset.state === s, wanted, { timeout });

  test('the video is shown as it is as long as there are no tiles, and in depth once they came', async () => {
    const publisher = await suite.publish('attic');
    const { page, context, errors } = await suite.watch('attic', { prepare: withoutTiles });
    await waitForMode(page, 'flat');
    await page.getByText('The picture has no depth yet.').waitFor();
    assert.ok(await page.locator('#loading').isHidden());
    await showsFrames(page, 5);
    const { same, other } = likenessOf(await flatPixels(page));
    assert.ok(same > 22 && same > other + 3, `${same} dB, half a film away ${other} dB`);
    await page.evaluate(() => window.come());
    await waitForMode(page, 'gpu');
    await page.getByText('Move the pointer or drag to look around.').waitFor();
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('without a microphone that works there is a picture, and nobody is promised sound', async () => {
    const publisher = await suite.publish('mute', {
      prepare: (page) =>
        page.addInitScript(() => {
          AudioWorklet.prototype.addModule = () => Promise.reject(new Error('no worklet'));
        }),
    });
    await publisher.page.getByText('You are live, without sound: the microphone does not work.').waitFor();
    const { page, context } = await suite.watch('mute');
    await waitForMode(page, 'gpu');
    assert.ok(await page.locator('#sound').isHidden());
    await context.close();
    await publisher.context.close();
  });

  test('sound that fails later is taken back, and the picture goes on', async () => {
    const publisher = await suite.publish('hoarse', {
      prepare: (page) =>
        page.addInitScript(() => {
          window.AudioEncoder = class extends AudioEncoder {
            constructor(init) {
              super(init);
              window.failSound = init.error;
            }
          };
        }),
    });
    const { page, context } = await suite.watch('hoarse');
    await waitForMode(page, 'gpu');
    await page.getByRole('button', { name: 'Sound' }).waitFor();
    await publisher.page.evaluate(() => window.failSound(new Error('the encoder is gone')));
    await page.locator('#sound').waitFor({ state: 'hidden' });
    // what is measured is there after the first frames
    const { frame } = await (await page.waitForFunction(() => window.measured)).jsonValue();
    await page.waitForFunction((before) => window.measured.frame !== before && window.measured.frames > 0, frame);
    await publisher.page.getByText('You are live, without sound').waitFor();
    await context.close();
    await publisher.context.close();
  });

  test('a camera that gives no frames pauses, and goes on by itself', async () => {
    const prepare = async (page) => {
      await standing(page);
      await kept(page);
    };
    const publisher = await suite.publish('cellar', { prepare });
    await publisher.page.evaluate(() => {
      window.still = true;
    });
    await state(publisher.page, 'paused');
    await publisher.page.getByText('Paused: the camera gives no picture while this page is hidden.').waitFor();
    // who is not there is not sent away for saying nothing
    await publisher.page.waitForFunction(() => window.sockets.every(({ readyState }) => readyState === WebSocket.CLOSED));
    await publisher.page.evaluate(() => {
      window.still = false;
    });
    await state(publisher.page, 'live');
    const { page, context } = await suite.watch('cellar');
    await waitForMode(page, 'gpu');
    await context.close();
    await publisher.context.close();
  });

  test('a publisher whose link is good no more is told so, and does not try for ever', async () => {
    const publisher = await suite.publish('garden', {
      prepare: async (page) => {
        await kept(page);
        await page.clock.install();
      },
    });
    await publisher.page.route('**/v1/live/garden', (route) => route.fulfill({ status: 403, body: '{}' }));
    await publisher.page.evaluate(() => window.sockets.at(-1).close());
    // as the page is told of a connection that broke
    await publisher.page.getByText('the link is no longer valid').waitFor();
    await state(publisher.page, 'ended');
    const opened = await publisher.page.evaluate(() => window.sockets.length);
    await publisher.page.clock.fastForward(60_000);
    await frames(publisher.page, 5);
    assert.equal(await publisher.page.evaluate(() => window.sockets.length), opened);
    await publisher.context.close();
  });

  test('who finds no place is told so, and waits', async () => {
    const publisher = await suite.publish('hall');
    const full = { publishing: true, viewers: 1024, full: true, may_publish: false };
    const crowd = (page) => page.route('**/v1/live/hall', (route) => route.fulfill({ json: full }));
    const { page, context } = await suite.watch('hall', { prepare: crowd });
    await page.getByText('The room is full. This page tries again by itself.').waitFor();
    await page.unroute('**/v1/live/hall');
    await waitForMode(page, 'gpu');
    await context.close();
    await publisher.context.close();
  });
});
