// Compares streams of many formats with ffmpeg, and checks the messages for unsupported streams.
import assert from 'node:assert/strict';
import { execFileSync, spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, pixelsAt, ROOM, waitForMode } from '../support/browser.mjs';
import { program, startServer } from '../support/program.mjs';
import { skip } from '../support/skip.mjs';
import { until } from '../support/until.mjs';

/** PSNR in dB from which a page shows the same as ffmpeg except for rounding and soft edges. */
const SAME_DB = 36;
/** The same if the program transcodes the film. */
const TRANSCODED_DB = 28;

const hasFfmpeg = () => {
  try {
    return Boolean(execFileSync('ffmpeg', ['-version']));
  } catch {
    return false;
  }
};

const ffmpeg = (args, input) => execFileSync('ffmpeg', ['-loglevel', 'error', '-y', ...args], { input, maxBuffer: 1 << 30 });

describe('streams', () => {
  const folder = mkdtempSync(join(tmpdir(), 'tmpi-streams-'));
  let [server, browser] = [null, null];
  before(async () => {
    [server, browser] = [await startServer(), await launch()];
  });
  after(async () => {
    await browser?.close();
    await server?.close();
    rmSync(folder, { recursive: true, force: true });
  });

  /** PSNR of two RGBA pictures in dB. */
  function psnr(a, b) {
    assert.equal(a.length, b.length);
    const sum = a.reduce((sum, value, i) => (i % 4 === 3 ? sum : sum + (value - b[i]) ** 2), 0);
    return 10 * Math.log10((255 * 255 * a.length * 0.75) / Math.max(sum, 1e-9));
  }

  /** The same film with a rotation of 90 degrees in its metadata. */
  function rotated(film) {
    const file = join(folder, 'rotated.mp4');
    try {
      ffmpeg(['-display_rotation', '90', '-i', film, '-c', 'copy', file]);
    } catch {
      // the option of older ffmpeg versions
      ffmpeg(['-i', film, '-c', 'copy', '-metadata:s:v', 'rotate=90', file]);
    }
    return file;
  }

  /** Encodes an H.264 film of one repeated picture, longer than a test takes: two seconds, which a raw stream repeats. */
  function film(name, { size = '320x240', filters = 'null', parameters = '', more = [], seconds = 60 }) {
    const file = join(folder, name);
    const times = name.endsWith('.h264') ? Math.ceil(seconds / 2) : 1;
    // whole groups of pictures
    const repeats = (seconds / times) * 10 - 1;
    const source = `testsrc2=size=${size}:rate=10:duration=0.1,loop=${repeats}:1:0,setpts=N/10/TB,${filters}`;
    const coder = ['-c:v', 'libx264', '-preset', 'veryfast', '-bf', '0', '-crf', '8', '-x264-params', `keyint=10:${parameters}`];
    ffmpeg(['-f', 'lavfi', '-i', source, ...coder, ...more, file]);
    if (times > 1) writeFileSync(file, Buffer.concat(Array(times).fill(readFileSync(file))));
    return file;
  }

  /** First picture of a film from ffmpeg: RGBA and size. */
  function reference(file, reading = '') {
    const args = ['-loglevel', 'error', '-select_streams', 'v:0', '-show_entries', 'stream=width,height', '-of', 'csv=p=0', file];
    const info = execFileSync('ffprobe', args);
    let [width, height] = String(info).split('\n')[0].split(',').map(Number);
    const filter = `scale=${reading}flags=neighbor+accurate_rnd+full_chroma_int`;
    // apply the cropping exactly
    const pixels = ffmpeg(['-flags', 'unaligned', '-i', file, '-frames:v', '1', '-vf', filter, '-f', 'rawvideo', '-pix_fmt', 'rgba', '-']);
    if (file.includes('rotated')) [width, height] = [height, width];
    return { pixels, width, height };
  }

  /** Publishes a file with the program until `stop`; `log` is its stderr. */
  function publish(room, file, rate = 10) {
    const child = spawn(program, ['live', 'publish', file, '--room', `${server.url}/live/${room}`, '--rate', String(rate)]);
    const result = { log: '', ended: new Promise((resolve) => child.on('exit', resolve)), stop: () => child.kill() };
    child.stderr.on('data', (text) => (result.log += text));
    return result;
  }

  /** PSNR in dB of the page's picture to a reference, once both have the same size. */
  async function pagePsnr(page, { pixels, width, height }) {
    await page.waitForFunction(([w, h]) => window.viewer?.head?.width === w && window.viewer.head.height === h, [width, height]);
    await waitForMode(page, 'gpu');
    let same = 0;
    // after a size change the old picture stays until the next frame
    await until(async () => {
      const before = same;
      same = psnr(await pixelsAt(page, {}, width, height), pixels);
      return same > TRANSCODED_DB && same <= before + 0.5;
    }).catch(() => {});
    return same;
  }

  const KINDS = [
    ['cropped on all sides', { parameters: 'crop-rect=6,4,10,8' }, 'in_color_matrix=bt709:'],
    ['cropped at top and bottom, as from small computers', { parameters: 'crop-rect=0,4,0,4' }, 'in_color_matrix=bt709:'],
    ['marked as interlaced with progressive frames', { parameters: 'fake-interlaced=1' }, 'in_color_matrix=bt709:'],
    [
      'in BT.601',
      { filters: 'scale=out_color_matrix=bt601,format=yuv420p', parameters: 'colormatrix=smpte170m' },
      'in_color_matrix=bt601:',
    ],
    [
      'in BT.2020',
      { filters: 'scale=out_color_matrix=bt2020,format=yuv420p', parameters: 'colormatrix=bt2020nc' },
      'in_color_matrix=bt2020:',
    ],
    [
      'in full range',
      { filters: 'scale=out_color_matrix=bt709:out_range=pc,format=yuvj420p', parameters: 'colormatrix=bt709:fullrange=on' },
      'in_color_matrix=bt709:in_range=pc:',
    ],
  ];
  for (const [at, [name, options, reading]] of KINDS.entries()) {
    test(`a stream ${name} looks as in ffmpeg`, async (t) => {
      if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'ffmpeg is not installed');
      const plain = options.filters ? {} : { filters: 'scale=out_color_matrix=bt709,format=yuv420p' };
      const file = film(`kind${at}.h264`, { ...plain, ...options });
      const publisher = publish(`kind${at}`, file);
      const { page, context, errors } = await openPage(browser, ROOM);
      await page.goto(`${server.url}/live/kind${at}`);
      const same = await pagePsnr(page, reference(file, reading));
      assert.ok(same > SAME_DB, `${same.toFixed(1)} dB; ${publisher.log}`);
      assert.deepEqual(errors, []);
      publisher.stop();
      await context.close();
    });
  }

  test('rotated films are upright, interlaced films deinterlaced', async (t) => {
    if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'ffmpeg is not installed');
    const lying = film('lying.mp4', { filters: 'format=yuv420p', more: ['-profile:v', 'baseline'] });
    for (const [room, file] of [
      ['rotated', rotated(lying)],
      ['fields', film('fields.h264', { filters: 'format=yuv420p', parameters: 'interlaced=1' })],
    ]) {
      const publisher = publish(room, file);
      const { page, context } = await openPage(browser, ROOM);
      await page.goto(`${server.url}/live/${room}`);
      const same = await pagePsnr(page, reference(file, 'in_color_matrix=bt601:'));
      assert.ok(same > TRANSCODED_DB, `${room}: ${same.toFixed(1)} dB; ${publisher.log}`);
      publisher.stop();
      await context.close();
    }
  });

  test('viewers follow a change of video size', async (t) => {
    if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'ffmpeg is not installed');
    const filters = 'scale=out_color_matrix=bt709,format=yuv420p';
    const [wide, high] = [film('wide.h264', { filters, seconds: 40 }), film('high.h264', { size: '240x320', filters })];
    const both = join(folder, 'both.h264');
    writeFileSync(both, Buffer.concat([readFileSync(wide), readFileSync(high)]));
    const { page, context, errors } = await openPage(browser, ROOM);
    await page.goto(`${server.url}/live/turn`);
    await page.getByText('Nobody is live here yet').waitFor();
    await page.evaluate(() => {
      window.notReloaded = true;
    });
    const publisher = publish('turn', both, 20);
    for (const file of [wide, high]) {
      const same = await pagePsnr(page, reference(file, 'in_color_matrix=bt709:'));
      assert.ok(same > SAME_DB, `${file}: ${same.toFixed(1)} dB; ${publisher.log}`);
    }
    assert.ok(await page.evaluate(() => window.notReloaded));
    assert.deepEqual(errors, []);
    publisher.stop();
    await context.close();
  });

  /** Publishes frames from the page; returns the reason of the server's BYE. */
  const publishFrames = (page, room, frames) =>
    page.evaluate(
      async ([name, units]) => {
        const { compiled, RoomDecoder } = await import('/static/live/decoder.js');
        const { openSocket } = await import('/static/live/connection.js');
        const wire = await RoomDecoder.of(await compiled());
        const socket = openSocket(`${location.origin}/v1/live/${name}`, 'publish', '');
        let frame = 0;
        return new Promise((resolve) => {
          socket.onopen = () => socket.send(wire.writeHello({ width: 320, height: 240, codec: 'avc1.42e01e' }));
          socket.onmessage = ({ data }) => {
            const message = wire.read(new Uint8Array(data));
            if (message.kind === 'bye') resolve(message.reason);
            for (let i = 0; message.kind === 'credit' && i < message.frames && frame < units.length; i++) {
              const { bytes, key } = units[frame];
              socket.send(wire.writeVideo({ frame, time: frame * 100_000, key, data: Uint8Array.from(bytes) }));
              frame++;
            }
          };
        });
      },
      [room, frames],
    );

  /** Splits a stream with one slice per picture into access units. */
  function accessUnits(file) {
    const data = readFileSync(file);
    const all = [];
    let [start, slices] = [0, 0];
    for (let i = 0; i + 4 < data.length; i++) {
      if (data[i] || data[i + 1] || data[i + 2] !== 1) continue;
      const kind = data[i + 3] & 31;
      if (slices && [1, 5, 6, 7, 9].includes(kind)) {
        const end = data[i - 1] === 0 ? i - 1 : i;
        all.push(data.subarray(start, end));
        [start, slices] = [end, 0];
      }
      if (kind === 1 || kind === 5) slices++;
    }
    return [...all, data.subarray(start)].map((bytes) => ({
      bytes: [...bytes],
      key: bytes.some((b, i) => b === 1 && !bytes[i - 1] && !bytes[i - 2] && (bytes[i + 1] & 31) === 5),
    }));
  }

  test('unsupported video ends with a reason for everyone', async (t) => {
    if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'ffmpeg is not installed');
    const good = accessUnits(film('good.h264', { filters: 'format=yuv420p', more: ['-profile:v', 'baseline'], seconds: 20 })).slice(0, 120);
    const bad = accessUnits(film('chroma.h264', { filters: 'format=yuv422p', seconds: 1 }));
    const { page, context } = await openPage(browser, ROOM);
    await page.goto(`${server.url}/live/odd`);
    await page.getByText('Nobody is live here yet').waitFor();
    const publisher = await openPage(browser, ROOM);
    await publisher.page.goto(`${server.url}/live/odd/publish`);
    const reason = await publishFrames(publisher.page, 'odd', [...good, ...bad]);
    assert.match(reason, /4:2:0/);
    await page.getByText(reason).first().waitFor();
    assert.ok(await page.getByText('Loading…').isHidden());
    await context.close();
    await publisher.context.close();
  });

  /** Replaces the video decoder in the room's worker, where time runs three times as fast; `script` is the body of decode(). */
  const fakeDecoder = (page, script) =>
    page.addInitScript(
      (text) => {
        const { Worker: Plain } = window;
        window.Worker = class extends Plain {
          constructor(url) {
            const start = `const early = []; self.onmessage = (event) => early.push(event);
            const now = performance.now.bind(performance); performance.now = () => 3 * now(); ${text};
            await import(${JSON.stringify(new URL(url, location.href).href)}); for (const event of early) self.onmessage(event);`;
            super(URL.createObjectURL(new Blob([start], { type: 'text/javascript' })), { type: 'module' });
          }
        };
      },
      `self.VideoDecoder = class {
      static isConfigSupported = async () => ({ supported: true });
      state = 'unconfigured';
      constructor(on) { this.on = on; }
      configure() { this.state = 'configured'; }
      close() { this.state = 'closed'; }
      decode() { ${script} }
    }`,
    );

  for (const [kind, script] of [
    ['fails', "this.on.error(new Error('hardware')); "],
    ['returns nothing', ''],
  ]) {
    test(`shows an error if the decoder ${kind}`, async (t) => {
      if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'ffmpeg is not installed');
      const room = `mute-${kind.length}`;
      const publisher = publish(room, film(`${room}.h264`, { filters: 'format=yuv420p' }));
      const { page, context } = await openPage(browser, ROOM);
      await fakeDecoder(page, script);
      await page.goto(`${server.url}/live/${room}`);
      await page.getByText('This browser cannot show the video of this room').waitFor();
      assert.ok(await page.getByText('Loading…').isHidden());
      publisher.stop();
      await context.close();
    });
  }
});
