// A publishing phone that rotates: viewers keep watching, upright and in the new shape.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { pixelsAt, waitForMode } from '../support/browser.mjs';
import { roomSuite } from '../support/room.mjs';
import { until } from '../support/until.mjs';

const [LONG, SHORT] = [320, 240];
/** Tolerance of a colour in levels after compression. */
const TOLERANCE = 40;

/** In the page: a fake camera that shows red above blue; `window.rotate(width, height, rotation)` rotates it. */
function fakeCamera([width, height]) {
  const canvas = document.createElement('canvas');
  let rotation = 0;
  window.rotate = (w, h, by = 0) => {
    [canvas.width, canvas.height, rotation] = by % 180 ? [h, w, by] : [w, h, by];
  };
  window.rotate(width, height);
  const generator = new MediaStreamTrackGenerator({ kind: 'video' });
  const writer = generator.writable.getWriter();
  let n = 0;
  const draw = () => {
    const { width: w, height: h } = canvas;
    const context = canvas.getContext('2d');
    // the sensor's picture, which is red above after the clockwise rotation
    const [x, y] = { 0: [0, 0], 90: [0, 0], 180: [0, h / 2], 270: [w / 2, 0] }[rotation];
    context.fillStyle = '#1030d0';
    context.fillRect(0, 0, w, h);
    context.fillStyle = '#d02010';
    context.fillRect(x, y, rotation % 180 ? w / 2 : w, rotation % 180 ? h : h / 2);
    context.fillStyle = '#ffffff';
    context.fillRect(w / 2 - 10 + 10 * (n++ % 3), h / 2 - 10, 20, 20);
    const frame = new VideoFrame(canvas, { timestamp: performance.now() * 1000, rotation });
    writer.write(frame).catch(() => {});
  };
  setInterval(draw, 80);
  navigator.mediaDevices.getUserMedia = async () => new MediaStream([generator]);
}

describe('a phone that rotates while it publishes', () => {
  const suite = roomSuite();

  /** Waits until the viewer sees pictures of this size, red above blue. */
  async function waitForUpright(page, [width, height]) {
    await page.waitForFunction(([w, h]) => window.viewer?.head?.width === w && window.viewer.head.height === h, [width, height]);
    await waitForMode(page, 'gpu');
    const near = (pixels, x, y, colour) => {
      const at = 4 * (Math.round(y * height) * width + Math.round(x * width));
      return colour.every((value, c) => Math.abs(pixels[at + c] - value) < TOLERANCE);
    };
    let details = '';
    await until(
      async () => {
        const pixels = await pixelsAt(page, {}, width, height);
        const places = [0.15, 0.85].map((x) => [near(pixels, x, 0.2, [208, 32, 16]), near(pixels, x, 0.8, [16, 48, 208])]);
        details = JSON.stringify(places);
        return places.flat().every(Boolean);
      },
      () => details,
    );
  }

  for (const [how, rotations] of [
    [
      'with pictures of the new shape',
      [
        [SHORT, LONG],
        [LONG, SHORT],
      ],
    ],
    [
      'with rotation metadata',
      [
        [SHORT, LONG, 90],
        [LONG, SHORT, 180],
        [SHORT, LONG, 270],
      ],
    ],
  ]) {
    test(`keeps its viewers, ${how}`, async () => {
      const room = `turned${rotations.length}`;
      const prepare = (page) => page.addInitScript(`(${fakeCamera})(${JSON.stringify([LONG, SHORT])})`);
      const publisher = await suite.publish(room, { prepare });
      const { page, context, errors } = await suite.watch(room);
      await waitForUpright(page, [LONG, SHORT]);
      await page.evaluate(() => {
        window.notReloaded = true;
      });
      for (const [width, height, rotation] of rotations) {
        await publisher.page.evaluate((rotation) => window.rotate(...rotation), [width, height, rotation]);
        await waitForUpright(page, [width, height]);
        assert.equal(await publisher.page.evaluate(() => document.body.dataset.state), 'live');
      }
      // back and forth at once
      await publisher.page.evaluate(
        async ([long, short]) => {
          for (let i = 0; i < 5; i++) {
            window.rotate(...(i % 2 ? [long, short] : [short, long]));
            await new Promise((resume) => setTimeout(resume, 170));
          }
        },
        [LONG, SHORT],
      );
      await waitForUpright(page, [SHORT, LONG]);
      assert.ok(await page.evaluate(() => window.notReloaded), 'the page did not reload');
      assert.deepEqual([...errors, ...publisher.errors], []);
      await publisher.context.close();
      await context.close();
    });
  }
});
