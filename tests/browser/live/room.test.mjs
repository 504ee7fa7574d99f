// A room on the built program: one page publishes a fake camera, another watches.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { disableGraphics, fractionDifferent, pixelsAt, seriousViolations, waitForMode } from '../support/browser.mjs';
import { compareWithFilm, flatPixels, roomSuite, SAME_DB, saveScreenshot, shownFrame, waitForFrames } from '../support/room.mjs';
import { until } from '../support/until.mjs';
import { FRAMES, HEIGHT, WIDTH } from '../support/video.mjs';

/** Formats the page's measurements. */
const formatStats = (stats) =>
  `layers ${stats.madeMs.toFixed(1)} ms, pixels ${stats.copyMs.toFixed(1)} ms, video ${stats.videoMs.toFixed(1)} ms, behind the camera ${stats.latency.toFixed(0)} ms, ` +
  `${stats.frames.toFixed(0)} frames/s, ${stats.kbits.toFixed(0)} kbit/s, tiles after ${stats.geometryMs.toFixed(0)} ms`;

describe('a room', () => {
  const suite = roomSuite();

  test('viewers see the camera and look around', async (t) => {
    const publisher = await suite.publish('attic');
    t.diagnostic(`codec ${await publisher.page.evaluate(() => window.publisher.codec)}`);
    const { page, context, errors } = await suite.watch('attic');
    await waitForMode(page, 'gpu');
    const numbers = new Set();
    const likeness = [];
    await until(
      async () => {
        const { number, same, other } = await shownFrame(page);
        assert.ok(number < FRAMES && same > other + 3, `frame ${number}: ${same} dB, half a film away ${other} dB`);
        likeness.push(same);
        return numbers.add(number).size > 3;
      },
      () => [...numbers],
    );
    t.diagnostic(`PSNR to the source: ${likeness.map((v) => v.toFixed(1)).join(', ')} dB`);
    assert.ok(Math.min(...likeness) > SAME_DB, `${likeness}`);
    await saveScreenshot(page, 'watch-home');
    const home = await pixelsAt(page, {}, WIDTH, HEIGHT);
    const moved = await pixelsAt(page, { tx: 0.05, yaw: -1 }, WIDTH, HEIGHT);
    assert.ok(fractionDifferent(home, moved, WIDTH, HEIGHT) > 0.1, 'a moved camera changes the picture');
    const empty = moved.filter((_, i) => i % 4 === 3).filter((a) => a < 250).length / (WIDTH * HEIGHT);
    assert.ok(empty < 0.03, `${empty} of the moved picture is empty`);
    await saveScreenshot(page, 'watch-moved');
    await page.getByRole('button', { name: 'Sound' }).click();
    // the fake microphone beeps once a second
    await page.waitForFunction(() => {
      window.loudest = Math.max(window.loudest ?? 0, window.sound.level);
      return window.sound.played > 1 && window.loudest > 0.01;
    });
    // the video continues: frames do not block each other
    const { frame: before } = await page.evaluate(() => window.measured);
    await page.waitForFunction((n) => window.measured.frame > n, before, { timeout: 5000 });
    assert.match(await page.locator('#readout').textContent(), /\d+ ms · \d+ frames\/s · \d+ kbit\/s/);
    t.diagnostic(formatStats(await page.evaluate(() => window.measured)));
    assert.deepEqual(await seriousViolations(page), []);
    await publisher.page.waitForFunction(() => /1 watching/.test(document.getElementById('state').textContent));
    await saveScreenshot(publisher.page, 'publish-live');
    assert.equal(await publisher.page.locator('#link').inputValue(), `${suite.server.url}/live/attic`);
    assert.deepEqual(await seriousViolations(publisher.page), []);
    await publisher.page.getByRole('button', { name: 'Stop' }).click();
    await publisher.page.getByText('You are no longer live.').waitFor();
    await page.waitForFunction(() => ['ended', 'stalled'].includes(document.body.dataset.state));
    await saveScreenshot(page, 'watch-stalled');
    // the publisher starts again, and viewers reconnect by themselves
    await publisher.page.getByRole('button', { name: 'Start' }).click();
    await page.waitForFunction(() => document.body.dataset.state === 'live');
    const frame = await page.evaluate(() => window.measured.frame);
    await page.waitForFunction((n) => window.measured.frame !== n && window.measured.frame > 5, frame);
    const { same } = await shownFrame(page);
    assert.ok(same > SAME_DB, `${same}`);
    assert.deepEqual([...errors, ...publisher.errors], []);
    await context.close();
    await publisher.context.close();
  });

  test('an early viewer waits; WebGL draws without WebGPU', async () => {
    const { page, context, errors } = await suite.watch('cellar', { prepare: (page) => disableGraphics(page, { webgl: true }) });
    await page.getByText('Nobody is live here yet. The picture starts by itself.').waitFor();
    await saveScreenshot(page, 'watch-waiting');
    const publisher = await suite.publish('cellar');
    await waitForMode(page, 'webgl');
    await waitForFrames(page, 5);
    const { same, other, pixels } = await shownFrame(page);
    assert.ok(same > SAME_DB && same > other + 3, `${same} dB, half a film away ${other} dB`);
    const moved = await pixelsAt(page, { tx: -0.05, yaw: 1 }, WIDTH, HEIGHT);
    assert.ok(fractionDifferent(pixels, moved, WIDTH, HEIGHT) > 0.1);
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('without graphics the video is flat, without WebCodecs JPEG', async (t) => {
    const prepare = (page) =>
      page.addInitScript(() => {
        // removes WebCodecs
        for (const name of ['VideoEncoder', 'VideoDecoder', 'VideoFrame', 'EncodedVideoChunk', 'MediaStreamTrackProcessor'])
          delete window[name];
      });
    const publisher = await suite.publish('garden', { prepare });
    assert.equal(await publisher.page.evaluate(() => window.publisher.codec), 'jpeg');
    const { page, context, errors } = await suite.watch('garden', { prepare: (page) => disableGraphics(page, { webgl: false }) });
    await waitForMode(page, 'flat');
    await page.getByText('This browser shows the video without depth.').waitFor();
    await waitForFrames(page, 5);
    const { same, other } = compareWithFilm(await flatPixels(page));
    t.diagnostic(`${same.toFixed(1)} dB, half a film away ${other.toFixed(1)} dB`);
    // the browser's colour matrices differ from tmpi's
    assert.ok(same > 22 && same > other + 3, `${same} dB, half a film away ${other} dB`);
    await saveScreenshot(page, 'watch-flat');
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('a moving camera draws the newest frame once per refresh', async (t) => {
    const publisher = await suite.publish('swing');
    const { page, context } = await suite.watch('swing');
    await waitForMode(page, 'gpu');
    await page.evaluate(() => {
      const { viewer } = window;
      const { draw, update } = viewer.renderer;
      window.counts = new Map();
      const count = (what) => {
        // the same value for all callbacks of a refresh
        const now = document.timeline.currentTime;
        const entry = window.counts.get(now) ?? { draws: 0, updates: 0, undrawn: 0 };
        window.counts.set(now, entry);
        entry[what]++;
        entry.undrawn = what === 'updates' ? entry.undrawn + 1 : 0;
      };
      viewer.renderer.draw = function (views) {
        count('draws');
        return draw.call(this, views);
      };
      viewer.renderer.update = function (change) {
        count('updates');
        return update.call(this, change);
      };
      viewer.setIdle(true);
    });
    const counted = () => page.evaluate(() => [...window.counts.values()]);
    await page.waitForFunction(() => [...window.counts.values()].filter(({ updates }) => updates).length > 20);
    const refreshes = await counted();
    const [draws, updates] = ['draws', 'updates'].map((what) => refreshes.reduce((sum, entry) => sum + entry[what], 0));
    t.diagnostic(`${refreshes.length} refreshes, ${draws} pictures, ${updates} frames of the room`);
    assert.ok(refreshes.length > updates, 'the camera moves between frames too');
    // a few extra draws are allowed
    assert.ok(refreshes.filter((entry) => entry.draws > 1).length <= 2, `${draws} pictures in ${refreshes.length} refreshes`);
    assert.ok(refreshes.every(({ undrawn }) => undrawn === 0));
    await context.close();
    await publisher.context.close();
  });

  test('both pages fit a phone and are in German', async () => {
    const phone = {
      viewport: { width: 360, height: 740 },
      deviceScaleFactor: 2,
      hasTouch: true,
      locale: 'de-DE',
    };
    const publisher = await suite.publish('kitchen', { options: phone });
    const watcher = await suite.watch('kitchen', { options: phone });
    await waitForMode(watcher.page, 'gpu');
    await watcher.page.waitForFunction(() => document.getElementById('readout').textContent);
    for (const [name, { page }] of Object.entries({ publisher, watcher })) {
      const [wide, inner] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
      assert.ok(wide <= inner, `the ${name}'s page is ${wide} pixels wide on ${inner}`);
      const english = await page.evaluate(() =>
        document.body.innerText.match(/\b(live picture|Camera|You|watching|Start|Stop|Sound|frames)\b/g),
      );
      assert.equal(english, null);
      await saveScreenshot(page, `phone-${name}`);
    }
    await watcher.context.close();
    await publisher.context.close();
  });
});
