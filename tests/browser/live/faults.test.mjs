// Faults in a room: missing tiles, a broken microphone, a frozen camera, an expired link, a full room.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { compareWithFilm, flatPixels, roomSuite, waitForFrames } from '../support/room.mjs';
import { waitForAnimationFrames } from '../support/until.mjs';

/** Delays tiles until the page calls `window.releaseTiles()`. */
const delayTiles = (page) =>
  page.addInitScript(() => {
    const tiles = new BroadcastChannel('tiles');
    window.releaseTiles = () => tiles.postMessage('release');
    const { Worker: Plain } = window;
    window.Worker = class extends Plain {
      constructor(url) {
        const script = `const early = []; self.onmessage = (event) => early.push(event);
          let wait = new Promise((release) => (new BroadcastChannel('tiles').onmessage = release)).then(() => (wait = null));
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

/** A camera without sound that gives no frames while `window.frozen` is set. */
const freezableCamera = (page) =>
  page.addInitScript(() => {
    delete window.MediaStreamTrackProcessor;
    const open = navigator.mediaDevices.getUserMedia.bind(navigator.mediaDevices);
    navigator.mediaDevices.getUserMedia = ({ video }) => open({ video });
    const { requestVideoFrameCallback: ask } = HTMLVideoElement.prototype;
    HTMLVideoElement.prototype.requestVideoFrameCallback = function (f) {
      const next = (...args) => (window.frozen ? ask.call(this, next) : f(...args));
      return ask.call(this, next);
    };
  });

/** Records the page's sockets in `window.sockets`. */
const recordSockets = (page) =>
  page.addInitScript(() => {
    window.sockets = [];
    window.WebSocket = class extends WebSocket {
      constructor(...args) {
        super(...args);
        window.sockets.push(this);
      }
    };
  });

describe('faults in a room', () => {
  const suite = roomSuite();
  const waitForState = (page, wanted) => page.waitForFunction((s) => document.body.dataset.state === s, wanted);

  test('the video is flat until tiles arrive', async () => {
    const publisher = await suite.publish('attic');
    const { page, context, errors } = await suite.watch('attic', { prepare: delayTiles });
    await waitForMode(page, 'flat');
    await page.getByText('The picture has no depth yet.').waitFor();
    assert.ok(await page.locator('#loading').isHidden());
    await waitForFrames(page, 5);
    const { same, other } = compareWithFilm(await flatPixels(page));
    assert.ok(same > 22 && same > other + 3, `${same} dB, half a film away ${other} dB`);
    await page.evaluate(() => window.releaseTiles());
    await waitForMode(page, 'gpu');
    await page.getByText('Move the pointer or drag to look around.').waitFor();
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('a broken microphone leaves a picture without sound', async () => {
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

  test('the picture continues when sound fails later', async () => {
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
    // measurements start after the first frames
    const { frame } = await (await page.waitForFunction(() => window.measured)).jsonValue();
    await page.waitForFunction((before) => window.measured.frame !== before && window.measured.frames > 0, frame);
    await publisher.page.getByText('You are live, without sound').waitFor();
    await context.close();
    await publisher.context.close();
  });

  test('a frozen camera pauses the room, then it resumes', async () => {
    const prepare = async (page) => {
      await freezableCamera(page);
      await recordSockets(page);
    };
    const publisher = await suite.publish('cellar', { prepare });
    await publisher.page.evaluate(() => {
      window.frozen = true;
    });
    await waitForState(publisher.page, 'paused');
    await publisher.page.getByText('Paused: the camera gives no picture while this page is hidden.').waitFor();
    // the paused page disconnects, so the server need not time it out
    await publisher.page.waitForFunction(() => window.sockets.every(({ readyState }) => readyState === WebSocket.CLOSED));
    await publisher.page.evaluate(() => {
      window.frozen = false;
    });
    await waitForState(publisher.page, 'live');
    const { page, context } = await suite.watch('cellar');
    await waitForMode(page, 'gpu');
    await context.close();
    await publisher.context.close();
  });

  test('a publisher with an expired link stops reconnecting', async () => {
    const publisher = await suite.publish('garden', {
      prepare: async (page) => {
        await recordSockets(page);
        await page.clock.install();
      },
    });
    await publisher.page.route('**/v1/live/garden', (route) => route.fulfill({ status: 403, body: '{}' }));
    await publisher.page.evaluate(() => window.sockets.at(-1).close());
    await publisher.page.getByText('the link is no longer valid').waitFor();
    await waitForState(publisher.page, 'ended');
    const opened = await publisher.page.evaluate(() => window.sockets.length);
    await publisher.page.clock.fastForward(60_000);
    await waitForAnimationFrames(publisher.page, 5);
    assert.equal(await publisher.page.evaluate(() => window.sockets.length), opened);
    await publisher.context.close();
  });

  test('a viewer of a full room waits for a place', async () => {
    const publisher = await suite.publish('hall');
    const full = { publishing: true, viewers: 1024, full: true, may_publish: false };
    const fakeFull = (page) => page.route('**/v1/live/hall', (route) => route.fulfill({ json: full }));
    const { page, context } = await suite.watch('hall', { prepare: fakeFull });
    await page.getByText('The room is full. This page tries again by itself.').waitFor();
    await page.unroute('**/v1/live/hall');
    await waitForMode(page, 'gpu');
    await context.close();
    await publisher.context.close();
  });
});
