// Films and GIFs made in the browser.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { skip } from '../support/skip.mjs';
import { boxSuite, STILL } from '../support/suite.mjs';

describe('films', () => {
  const suite = boxSuite();
  let page;
  let context;
  let errors;
  before(async () => {
    ({ page, context, errors } = await suite.open(STILL));
    await page.waitForFunction(() => window.viewer?.mode === 'gpu');
  });
  after(() => context?.close());

  /** Makes a film: its type, size, first bytes, and what progress said. */
  const make = (wish) =>
    page.evaluate(async (w) => {
      const { makeFilm } = await import('/static/film/film.js');
      const shares = [];
      const blob = await makeFilm(window.viewer, w, { progress: (share) => shares.push(share) });
      window.film = blob;
      const bytes = new Uint8Array(await blob.arrayBuffer());
      return { type: blob.type, size: bytes.length, head: String.fromCharCode(...bytes.subarray(0, 12)), shares };
    }, wish);

  /** Share of the samples of two pictures that differ by so much that no codec does it. */
  const OFF = `window.off = (a, b) => a.filter((v, i) => i % 4 < 3 && Math.abs(v - b[i]) > 48).length / (a.length * 0.75);
    window.seenAt = async (style, share, size) => {
      const { cameraAt, wayAt } = await import('/static/film/way.js');
      const { pose, k } = cameraAt(window.viewer, wayAt(style, share), size);
      return window.viewer.renderer.readPixels(pose, k, size.width, size.height);
    };`;

  /** The film as the browser plays it: its size and length, and how far a quarter of it is from the view there and from that after another half. */
  const played = async (style) => {
    await page.evaluate(OFF);
    return page.evaluate(async (way) => {
      const video = document.createElement('video');
      video.muted = true;
      video.src = URL.createObjectURL(window.film);
      const once = (type) =>
        new Promise((resume, fail) => {
          video.addEventListener(type, resume, { once: true });
          video.addEventListener('error', () => fail(new Error(video.error?.message)), { once: true });
        });
      await once('loadeddata');
      const seeked = once('seeked');
      // within the frame, not at its edge
      video.currentTime = video.duration / 4 + 0.01;
      await seeked;
      const size = { width: video.videoWidth, height: video.videoHeight };
      const context = new OffscreenCanvas(size.width, size.height).getContext('2d');
      // the first video of a page is black until its decoder has started
      let data;
      for (const end = performance.now() + 5000; performance.now() < end; await new Promise(requestAnimationFrame)) {
        context.drawImage(video, 0, 0);
        ({ data } = context.getImageData(0, 0, size.width, size.height));
        if (data.some((v, i) => i % 4 < 3 && v > 0)) break;
      }
      const [same, other] = [await window.seenAt(way, 0.25, size), await window.seenAt(way, 0.75, size)];
      return { ...size, duration: video.duration, same: window.off(data, same), other: window.off(data, other) };
    }, style);
  };

  for (const [kind, head] of [
    ['mp4', 'ftyp'],
    // EBML
    ['webm', '\x1aE\xdf\xa3'],
  ]) {
    test(`a film (.${kind}) where the browser has an encoder for one`, async (t) => {
      const able = await page.evaluate(async (container) => {
        const { encoding } = await import('/static/film/video.js');
        return (await encoding({ width: 200, height: 120, frameMs: 33 }, container))?.config.codec ?? null;
      }, kind);
      if (!able) {
        const refused = await make({ kind, style: 'swing', seconds: 2, side: 480 }).catch((error) => error.message);
        assert.match(refused, /no encoder/);
        return skip(t, 'chromium', `it has no encoder for a film of the kind ${kind}`);
      }
      const made = await make({ kind, style: 'orbit', seconds: 2, side: 480 });
      assert.equal(made.type, `video/${kind}`);
      assert.ok(made.head.includes(head), made.head);
      assert.deepEqual([made.shares.length, made.shares.at(-1)], [60, 1]);
      const seen = await played('orbit');
      t.diagnostic(`${able} ${made.size} bytes ${JSON.stringify(seen)}`);
      assert.ok(Math.abs(seen.duration - 2) < 0.1, `${seen.duration} s`);
      assert.ok(seen.other > 0.004 && seen.same < seen.other / 3, JSON.stringify(seen));
    });
  }

  test('a GIF goes on for ever and shows what the view shows', async (t) => {
    const made = await make({ kind: 'gif', style: 'wiggle', seconds: 2, side: 480 });
    assert.deepEqual([made.type, made.head.slice(0, 6)], ['image/gif', 'GIF89a']);
    await page.evaluate(OFF);
    const read = await page.evaluate(async () => {
      const decoder = new ImageDecoder({ data: await window.film.arrayBuffer(), type: 'image/gif' });
      await decoder.tracks.ready;
      const { frameCount, repetitionCount } = decoder.tracks.selectedTrack;
      const pictures = [];
      let duration = 0;
      for (let i = 0; i < frameCount; i++) {
        const { image } = await decoder.decode({ frameIndex: i });
        duration += image.duration / 1000;
        const context = new OffscreenCanvas(image.displayWidth, image.displayHeight).getContext('2d');
        context.drawImage(image, 0, 0);
        pictures.push(context.getImageData(0, 0, image.displayWidth, image.displayHeight).data);
      }
      const size = { width: 200, height: 120 };
      const [left, middle] = [await window.seenAt('wiggle', 0, size), await window.seenAt('wiggle', 0.3, size)];
      return {
        frameCount,
        forever: repetitionCount === Infinity,
        duration,
        same: window.off(pictures[0], left),
        other: window.off(pictures[0], middle),
        again: window.off(pictures[1], pictures[3]),
      };
    });
    t.diagnostic(JSON.stringify(read));
    assert.deepEqual([read.frameCount, read.forever, Math.round(read.duration)], [4, true, 480]);
    assert.ok(read.other > 0.004 && read.same < read.other / 3, JSON.stringify(read));
    assert.equal(read.again, 0, 'the middle is shown twice');
  });

  test('what is cancelled ends soon, and the viewer goes on', async () => {
    const ended = await page.evaluate(async () => {
      const { makeFilm } = await import('/static/film/film.js');
      const stop = new AbortController();
      let frames = 0;
      const name = await makeFilm(
        window.viewer,
        { kind: 'gif', style: 'dolly', seconds: 8, side: 480 },
        {
          signal: stop.signal,
          progress: () => ++frames === 3 && stop.abort(),
        },
      ).then(
        () => 'made',
        (error) => error.name,
      );
      return { name, frames, asleep: window.viewer.asleep };
    });
    assert.deepEqual(ended, { name: 'AbortError', frames: 3, asleep: false });
    assert.deepEqual(errors, []);
  });
});
