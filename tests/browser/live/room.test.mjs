// From a fake camera to the moving picture, on the built program: one page publishes, another watches.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { pixelsAt, seriousViolations, shareDifferent, takeGraphics, waitForMode } from '../support/browser.mjs';
import { flatPixels, likenessOf, roomSuite, SAME_DB, shoot, shown, showsFrames } from '../support/room.mjs';
import { until } from '../support/until.mjs';
import { FRAMES, HEIGHT, WIDTH } from '../support/video.mjs';

/** What the page measures, in a line. */
const line = (told) =>
  `layers ${told.madeMs.toFixed(1)} ms, pixels ${told.copyMs.toFixed(1)} ms, video ${told.videoMs.toFixed(1)} ms, behind the camera ${told.latency.toFixed(0)} ms, ` +
  `${told.frames.toFixed(0)} frames/s, ${told.kbits.toFixed(0)} kbit/s, tiles after ${told.geometryMs.toFixed(0)} ms`;

describe('a room', () => {
  const suite = roomSuite();

  test('what a camera sees is what others see, and they look around in it', async (t) => {
    const publisher = await suite.publish('attic');
    t.diagnostic(`codec ${await publisher.page.evaluate(() => window.publisher.codec)}`);
    const { page, context, errors } = await suite.watch('attic');
    await waitForMode(page, 'gpu');
    const numbers = new Set();
    const likeness = [];
    await until(
      async () => {
        const { number, same, other } = await shown(page);
        assert.ok(number < FRAMES && same > other + 3, `frame ${number}: ${same} dB, half a film away ${other} dB`);
        likeness.push(same);
        return numbers.add(number).size > 3;
      },
      () => [...numbers],
    );
    t.diagnostic(`likeness to the source: ${likeness.map((v) => v.toFixed(1)).join(', ')} dB`);
    assert.ok(Math.min(...likeness) > SAME_DB, `${likeness}`);
    await shoot(page, 'watch-home');
    const home = await pixelsAt(page, {}, WIDTH, HEIGHT);
    const moved = await pixelsAt(page, { tx: 0.05, yaw: -1 }, WIDTH, HEIGHT);
    assert.ok(shareDifferent(home, moved, WIDTH, HEIGHT) > 0.1, 'a moved camera sees something else');
    const empty = moved.filter((_, i) => i % 4 === 3).filter((a) => a < 250).length / (WIDTH * HEIGHT);
    assert.ok(empty < 0.03, `${empty} of the moved picture is torn open`);
    await shoot(page, 'watch-moved');
    await page.getByRole('button', { name: 'Sound' }).click();
    // the fake microphone beeps once a second
    await page.waitForFunction(() => {
      window.loudest = Math.max(window.loudest ?? 0, window.sound.level);
      return window.sound.played > 1 && window.loudest > 0.01;
    });
    // it goes on: frames do not wait for each other
    const { frame: before } = await page.evaluate(() => window.measured);
    await page.waitForFunction((n) => window.measured.frame > n, before, { timeout: 5000 });
    assert.match(await page.locator('#readout').textContent(), /\d+ ms · \d+ frames\/s · \d+ kbit\/s/);
    t.diagnostic(line(await page.evaluate(() => window.measured)));
    assert.deepEqual(await seriousViolations(page), []);
    await publisher.page.waitForFunction(() => /1 watching/.test(document.getElementById('state').textContent));
    await shoot(publisher.page, 'publish-live');
    assert.equal(await publisher.page.locator('#link').inputValue(), `${suite.server.url}/live/attic`);
    assert.deepEqual(await seriousViolations(publisher.page), []);
    await publisher.page.getByRole('button', { name: 'Stop' }).click();
    await publisher.page.getByText('You are no longer live.').waitFor();
    await page.waitForFunction(() => ['ended', 'stalled'].includes(document.body.dataset.state));
    await shoot(page, 'watch-stalled');
    // the same camera anew: who watches need do nothing
    await publisher.page.getByRole('button', { name: 'Start' }).click();
    await page.waitForFunction(() => document.body.dataset.state === 'live');
    const frame = await page.evaluate(() => window.measured.frame);
    await page.waitForFunction((n) => window.measured.frame !== n && window.measured.frame > 5, frame);
    const { same } = await shown(page);
    assert.ok(same > SAME_DB, `${same}`);
    assert.deepEqual([...errors, ...publisher.errors], []);
    await context.close();
    await publisher.context.close();
  });

  test('who comes first waits for the picture, by WebGL where there is no WebGPU', async () => {
    const { page, context, errors } = await suite.watch('cellar', { prepare: (page) => takeGraphics(page, { webgl: true }) });
    await page.getByText('Nobody is live here yet. The picture starts by itself.').waitFor();
    await shoot(page, 'watch-waiting');
    const publisher = await suite.publish('cellar');
    await waitForMode(page, 'webgl');
    await showsFrames(page, 5);
    const { same, other, pixels } = await shown(page);
    assert.ok(same > SAME_DB && same > other + 3, `${same} dB, half a film away ${other} dB`);
    const moved = await pixelsAt(page, { tx: -0.05, yaw: 1 }, WIDTH, HEIGHT);
    assert.ok(shareDifferent(pixels, moved, WIDTH, HEIGHT) > 0.1);
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('without either it is plain video; without an encoder the camera sends pictures', async (t) => {
    const prepare = (page) =>
      page.addInitScript(() => {
        // none of WebCodecs
        for (const name of ['VideoEncoder', 'VideoDecoder', 'VideoFrame', 'EncodedVideoChunk', 'MediaStreamTrackProcessor'])
          delete window[name];
      });
    const publisher = await suite.publish('garden', { prepare });
    assert.equal(await publisher.page.evaluate(() => window.publisher.codec), 'jpeg');
    const { page, context, errors } = await suite.watch('garden', { prepare: (page) => takeGraphics(page, { webgl: false }) });
    await waitForMode(page, 'flat');
    await page.getByText('This browser shows the video without depth.').waitFor();
    await showsFrames(page, 5);
    const { same, other } = likenessOf(await flatPixels(page));
    t.diagnostic(`${same.toFixed(1)} dB, half a film away ${other.toFixed(1)} dB`);
    // the browser's own matrices of colour are others than ours
    assert.ok(same > 22 && same > other + 3, `${same} dB, half a film away ${other} dB`);
    await shoot(page, 'watch-flat');
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('while the camera moves, a screen refresh draws the newest frame once', async (t) => {
    const publisher = await suite.publish('swing');
    const { page, context } = await suite.watch('swing');
    await waitForMode(page, 'gpu');
    await page.evaluate(() => {
      const { viewer } = window;
      const { draw, update } = viewer.renderer;
      window.counts = new Map();
      const count = (what) => {
        // the same for all that a refresh calls
        const now = document.timeline.currentTime;
        const of = window.counts.get(now) ?? { draws: 0, updates: 0, undrawn: 0 };
        window.counts.set(now, of);
        of[what]++;
        of.undrawn = what === 'updates' ? of.undrawn + 1 : 0;
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
    const [draws, updates] = ['draws', 'updates'].map((what) => refreshes.reduce((sum, of) => sum + of[what], 0));
    t.diagnostic(`${refreshes.length} refreshes, ${draws} pictures, ${updates} frames of the room`);
    assert.ok(refreshes.length > updates, 'the camera moves between frames, too');
    // somebody may ask for a picture besides
    assert.ok(refreshes.filter((of) => of.draws > 1).length <= 2, `${draws} pictures in ${refreshes.length} refreshes`);
    assert.ok(refreshes.every(({ undrawn }) => undrawn === 0));
    await context.close();
    await publisher.context.close();
  });

  test('both pages fit a phone and speak German', async () => {
    const phone = {
      viewport: { width: 360, height: 740 },
      deviceScaleFactor: 2,
      hasTouch: true,
      locale: 'de-DE',
      ...{ reducedMotion: 'reduce' },
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
      await shoot(page, `phone-${name}`);
    }
    await watcher.context.close();
    await publisher.context.close();
  });
});
