// Films and GIFs that the browser makes.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { boxSuite } from '../support/suite.mjs';

describe('films', () => {
  const suite = boxSuite();
  let page;
  let context;
  let errors;
  before(async () => {
    ({ page, context, errors } = await suite.open());
    await page.waitForFunction(() => window.viewer?.mode === 'gpu');
  });
  after(() => context?.close());

  /** Makes a film; returns its type, size, first bytes, and progress values. */
  const make = (options) =>
    page.evaluate(async (w) => {
      const { makeFilm } = await import('/static/film/film.js');
      const shares = [];
      const blob = await makeFilm(window.viewer, w, { progress: (share) => shares.push(share) });
      window.film = blob;
      const bytes = new Uint8Array(await blob.arrayBuffer());
      return { type: blob.type, size: bytes.length, head: String.fromCharCode(...bytes.subarray(0, 12)), shares };
    }, options);

  /** Fraction of samples that differ by more than a codec could cause; and the view at a point of the path. */
  const OFF = `window.off = (a, b) => a.filter((v, i) => i % 4 < 3 && Math.abs(v - b[i]) > 48).length / (a.length * 0.75);
    window.seenAt = async (style, share, size) => {
      const { cameraAt, pathAt } = await import('/static/film/camera-path.js');
      const { pose, k } = cameraAt(window.viewer, pathAt(style, share), size);
      return window.viewer.renderer.readPixels(pose, k, size.width, size.height);
    };`;

  /** Plays the film; returns size, duration, and the difference of the frame at a quarter from the views at one and at three quarters. */
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
      // inside the frame, not at its edge
      video.currentTime = video.duration / 4 + 0.01;
      await seeked;
      const size = { width: video.videoWidth, height: video.videoHeight };
      const context = new OffscreenCanvas(size.width, size.height).getContext('2d');
      // the first video of a page stays black until its decoder starts
      let data;
      const end = performance.now() + 60_000;
      do {
        if (performance.now() > end) throw new Error('the film stays black');
        await new Promise(requestAnimationFrame);
        context.drawImage(video, 0, 0);
        ({ data } = context.getImageData(0, 0, size.width, size.height));
      } while (data.every((v, i) => i % 4 === 3 || v === 0));
      const [same, other] = [await window.seenAt(way, 0.25, size), await window.seenAt(way, 0.75, size)];
      return { ...size, duration: video.duration, same: window.off(data, same), other: window.off(data, other) };
    }, style);
  };

  for (const [kind, head] of [
    ['mp4', 'ftyp'],
    // EBML
    ['webm', '\x1aE\xdf\xa3'],
  ]) {
    test(`makes a .${kind} film`, async (t) => {
      const made = await make({ kind, style: 'orbit', seconds: 2, side: 480 });
      assert.equal(made.type, `video/${kind}`);
      assert.ok(made.head.includes(head), made.head);
      assert.deepEqual([made.shares.length, made.shares.at(-1)], [60, 1]);
      const seen = await played('orbit');
      t.diagnostic(`${made.size} bytes ${JSON.stringify(seen)}`);
      assert.ok(Math.abs(seen.duration - 2) < 0.1, `${seen.duration} s`);
      assert.ok(seen.other > 0.004 && seen.same < seen.other / 3, JSON.stringify(seen));
    });
  }

  test('says that a browser has no encoder', async () => {
    await page.evaluate(() => {
      window.kept = VideoEncoder.isConfigSupported;
      VideoEncoder.isConfigSupported = async (config) => ({ supported: false, config });
    });
    for (const kind of ['mp4', 'webm']) await assert.rejects(make({ kind, style: 'swing', seconds: 2, side: 480 }), /no encoder/);
    await page.evaluate(() => {
      VideoEncoder.isConfigSupported = window.kept;
    });
  });

  test('makes a GIF that loops and shows the view', async (t) => {
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
    assert.equal(read.again, 0, 'the middle appears twice');
  });

  test('a cancelled film ends soon and the viewer resumes', async () => {
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
