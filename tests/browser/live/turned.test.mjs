// A phone that is turned while it publishes by the page: who watches goes on, upright and in the new shape.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { pixelsAt, waitForMode } from '../support/browser.mjs';
import { roomSuite } from '../support/room.mjs';
import { until } from '../support/until.mjs';

const [LONG, SHORT] = [320, 240];
/** Levels by which a colour of the picture may be off, coded and decoded. */
const OFF = 40;

/** Runs in the page: a camera whose pictures are red above and blue below, as they are shown; `window.turn(width, height, rotation)` turns it. */
function camera([width, height]) {
  const canvas = document.createElement('canvas');
  let rotation = 0;
  window.turn = (w, h, by = 0) => {
    [canvas.width, canvas.height, rotation] = by % 180 ? [h, w, by] : [w, h, by];
  };
  window.turn(width, height);
  const generator = new MediaStreamTrackGenerator({ kind: 'video' });
  const writer = generator.writable.getWriter();
  let n = 0;
  const draw = () => {
    const { width: w, height: h } = canvas;
    const context = canvas.getContext('2d');
    // as the sensor has it, so that it is red above once it is turned clockwise
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

describe('a phone that is turned while it publishes', () => {
  const suite = roomSuite();

  /** Waits until who watches sees pictures of that shape, red above and blue below. */
  async function seesUpright(page, [width, height]) {
    await page.waitForFunction(([w, h]) => window.viewer?.head?.width === w && window.viewer.head.height === h, [width, height]);
    await waitForMode(page, 'gpu');
    const near = (pixels, x, y, colour) => {
      const at = 4 * (Math.round(y * height) * width + Math.round(x * width));
      return colour.every((value, c) => Math.abs(pixels[at + c] - value) < OFF);
    };
    let told = '';
    await until(
      async () => {
        const pixels = await pixelsAt(page, {}, width, height);
        const places = [0.15, 0.85].map((x) => [near(pixels, x, 0.2, [208, 32, 16]), near(pixels, x, 0.8, [16, 48, 208])]);
        told = JSON.stringify(places);
        return places.flat().every(Boolean);
      },
      () => told,
    );
  }

  for (const [how, turns] of [
    [
      'and gives pictures of the new shape',
      [
        [SHORT, LONG],
        [LONG, SHORT],
      ],
    ],
    [
      'and says by how much they are to be turned',
      [
        [SHORT, LONG, 90],
        [LONG, SHORT, 180],
        [SHORT, LONG, 270],
      ],
    ],
  ]) {
    test(`${how}: who watches goes on`, async () => {
      const room = `turned${turns.length}`;
      const prepare = (page) => page.addInitScript(`(${camera})(${JSON.stringify([LONG, SHORT])})`);
      const publisher = await suite.publish(room, { prepare });
      const { page, context, errors } = await suite.watch(room);
      await seesUpright(page, [LONG, SHORT]);
      await page.evaluate(() => {
        window.stayed = true;
      });
      for (const [width, height, rotation] of turns) {
        await publisher.page.evaluate((turn) => window.turn(...turn), [width, height, rotation]);
        await seesUpright(page, [width, height]);
        assert.equal(await publisher.page.evaluate(() => document.body.dataset.state), 'live');
      }
      // back and forth at once
      await publisher.page.evaluate(
        async ([long, short]) => {
          for (let i = 0; i < 5; i++) {
            window.turn(...(i % 2 ? [long, short] : [short, long]));
            await new Promise((resume) => setTimeout(resume, 170));
          }
        },
        [LONG, SHORT],
      );
      await seesUpright(page, [SHORT, LONG]);
      assert.ok(await page.evaluate(() => window.stayed), 'the page was not loaded anew');
      assert.deepEqual([...errors, ...publisher.errors], []);
      await publisher.context.close();
      await context.close();
    });
  }
});
