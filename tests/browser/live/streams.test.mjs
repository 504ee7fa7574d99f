// Streams of every kind as people publish them, against what ffmpeg shows of them; and what is said of those that cannot be shown.
import assert from 'node:assert/strict';
import { execFileSync, spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, pixelsAt, waitForMode } from '../support/browser.mjs';
import { program, startServer } from '../support/program.mjs';
import { STILL } from '../support/room.mjs';
import { skip } from '../support/skip.mjs';
import { until } from '../support/until.mjs';

/** Likeness from which on a page shows what ffmpeg does, but for the rounding of two decoders and of what is soft, dB. */
const SAME_DB = 36;
/** The same where the film is coded anew on its way. */
const ANEW_DB = 28;

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

  /** Likeness of two pictures, RGBA, dB. */
  function psnr(a, b) {
    assert.equal(a.length, b.length);
    const sum = a.reduce((sum, value, i) => (i % 4 === 3 ? sum : sum + (value - b[i]) ** 2), 0);
    return 10 * Math.log10((255 * 255 * a.length * 0.75) / Math.max(sum, 1e-9));
  }

  /** The same film, to be turned by 90 degrees as it is shown. */
  function turned(film) {
    const file = join(folder, 'turned.mp4');
    try {
      ffmpeg(['-display_rotation', '90', '-i', film, '-c', 'copy', file]);
    } catch {
      // as older ones are told
      ffmpeg(['-i', film, '-c', 'copy', '-metadata:s:v', 'rotate=90', file]);
    }
    return file;
  }

  /** A film of one picture in H.264 that goes on for as long as a test may take; the size and the colours that ffmpeg is to read it by. */
  function film(name, { size = '320x240', filters = 'null', parameters = '', more = [], seconds = 60 }) {
    const file = join(folder, name);
    const source = `testsrc2=size=${size}:rate=10:duration=0.1,loop=${seconds * 10}:1:0,setpts=N/10/TB,${filters}`;
    const coder = ['-c:v', 'libx264', '-preset', 'veryfast', '-bf', '0', '-crf', '8', '-x264-params', `keyint=10:${parameters}`];
    ffmpeg(['-f', 'lavfi', '-i', source, ...coder, ...more, file]);
    return file;
  }

  /** RGBA of a film's first picture as ffmpeg shows it, and its size. */
  function reference(file, reading = '') {
    const asked = ['-loglevel', 'error', '-select_streams', 'v:0', '-show_entries', 'stream=width,height', '-of', 'csv=p=0', file];
    const info = execFileSync('ffprobe', asked);
    let [width, height] = String(info).split('\n')[0].split(',').map(Number);
    const filter = `scale=${reading}flags=neighbor+accurate_rnd+full_chroma_int`;
    // with all that is to be cut off cut off
    const pixels = ffmpeg(['-flags', 'unaligned', '-i', file, '-frames:v', '1', '-vf', filter, '-f', 'rawvideo', '-pix_fmt', 'rgba', '-']);
    if (file.includes('turned')) [width, height] = [height, width];
    return { pixels, width, height };
  }

  /** Publishes a file by the program until `stop`; `said` is what it said. */
  function publish(room, file, rate = 10) {
    const child = spawn(program, ['live', 'publish', file, '--room', `${server.url}/live/${room}`, '--rate', String(rate)]);
    const told = { said: '', ended: new Promise((resolve) => child.on('exit', resolve)), stop: () => child.kill() };
    child.stderr.on('data', (text) => (told.said += text));
    return told;
  }

  /** How like the page's picture from the camera's own place is to a reference, dB, once it is as large. */
  async function likeness(page, { pixels, width, height }) {
    await page.waitForFunction(([w, h]) => window.viewer?.head?.width === w && window.viewer.head.height === h, [width, height]);
    await waitForMode(page, 'gpu');
    let same = 0;
    // after a change of the size the picture of before is there until the next one
    await until(async () => {
      const before = same;
      same = psnr(await pixelsAt(page, {}, width, height), pixels);
      return same > ANEW_DB && same <= before + 0.5;
    }).catch(() => {});
    return same;
  }

  const KINDS = [
    ['cropped on all sides', { parameters: 'crop-rect=6,4,10,8' }, 'in_color_matrix=bt709:'],
    ['cropped above and below, as small computers do', { parameters: 'crop-rect=0,4,0,4' }, 'in_color_matrix=bt709:'],
    ['marked as interlaced, of whole frames', { parameters: 'fake-interlaced=1' }, 'in_color_matrix=bt709:'],
    [
      'of BT.601',
      { filters: 'scale=out_color_matrix=bt601,format=yuv420p', parameters: 'colormatrix=smpte170m' },
      'in_color_matrix=bt601:',
    ],
    [
      'of BT.2020',
      { filters: 'scale=out_color_matrix=bt2020,format=yuv420p', parameters: 'colormatrix=bt2020nc' },
      'in_color_matrix=bt2020:',
    ],
    [
      'of full range',
      { filters: 'scale=out_color_matrix=bt709:out_range=pc,format=yuvj420p', parameters: 'colormatrix=bt709:fullrange=on' },
      'in_color_matrix=bt709:in_range=pc:',
    ],
  ];
  for (const [at, [name, options, reading]] of KINDS.entries()) {
    test(`a stream ${name} is shown as ffmpeg shows it`, async (t) => {
      if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'there is no ffmpeg');
      const plain = options.filters ? {} : { filters: 'scale=out_color_matrix=bt709,format=yuv420p' };
      const file = film(`kind${at}.h264`, { ...plain, ...options });
      const publisher = publish(`kind${at}`, file);
      const { page, context, errors } = await openPage(browser, STILL);
      await page.goto(`${server.url}/live/kind${at}`);
      const same = await likeness(page, reference(file, reading));
      assert.ok(same > SAME_DB, `${same.toFixed(1)} dB; ${publisher.said}`);
      assert.deepEqual(errors, []);
      publisher.stop();
      await context.close();
    });
  }

  test('a film that is to be turned is shown upright, and one that is interlaced is made whole', async (t) => {
    if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'there is no ffmpeg');
    const lying = film('lying.mp4', { filters: 'format=yuv420p', more: ['-profile:v', 'baseline'] });
    for (const [room, file] of [
      ['turned', turned(lying)],
      ['fields', film('fields.h264', { filters: 'format=yuv420p', parameters: 'interlaced=1' })],
    ]) {
      const publisher = publish(room, file);
      const { page, context } = await openPage(browser, STILL);
      await page.goto(`${server.url}/live/${room}`);
      const same = await likeness(page, reference(file, 'in_color_matrix=bt601:'));
      assert.ok(same > ANEW_DB, `${room}: ${same.toFixed(1)} dB; ${publisher.said}`);
      publisher.stop();
      await context.close();
    }
  });

  test('who watches goes on where a camera is turned, at the new size', async (t) => {
    if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'there is no ffmpeg');
    const filters = 'scale=out_color_matrix=bt709,format=yuv420p';
    const [wide, high] = [film('wide.h264', { filters, seconds: 30 }), film('high.h264', { size: '240x320', filters })];
    const both = join(folder, 'both.h264');
    writeFileSync(both, Buffer.concat([readFileSync(wide), readFileSync(high)]));
    const publisher = publish('turn', both, 20);
    const { page, context, errors } = await openPage(browser, STILL);
    await page.goto(`${server.url}/live/turn`);
    await page.evaluate(() => {
      window.stayed = true;
    });
    for (const file of [wide, high]) {
      const same = await likeness(page, reference(file, 'in_color_matrix=bt709:'));
      assert.ok(same > SAME_DB, `${file}: ${same.toFixed(1)} dB; ${publisher.said}`);
    }
    assert.ok(await page.evaluate(() => window.stayed));
    assert.deepEqual(errors, []);
    publisher.stop();
    await context.close();
  });

  /** Frames of a film, as a page sends them: gives the reason that it is sent away with. */
  const sent = (page, room, frames) =>
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

  /** Access units of a stream whose pictures have one slice each. */
  function units(file) {
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

  test('what cannot be shown ends with a reason that publisher and watchers read', async (t) => {
    if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'there is no ffmpeg');
    const good = units(film('good.h264', { filters: 'format=yuv420p', more: ['-profile:v', 'baseline'], seconds: 20 })).slice(0, 120);
    const bad = units(film('chroma.h264', { filters: 'format=yuv422p', seconds: 1 }));
    const { page, context } = await openPage(browser, STILL);
    await page.goto(`${server.url}/live/odd`);
    await page.getByText('Nobody is live here yet').waitFor();
    const publisher = await openPage(browser);
    await publisher.page.goto(`${server.url}/live/odd/publish`);
    const reason = await sent(publisher.page, 'odd', [...good, ...bad]);
    assert.match(reason, /4:2:0/);
    await page.getByText(reason).first().waitFor();
    assert.ok(await page.getByText('Loading…').isHidden());
    await context.close();
    await publisher.context.close();
  });

  /** A page whose room's worker has decoders that do this. */
  const decoding = (page, script) =>
    page.addInitScript(
      (text) => {
        const { Worker: Plain } = window;
        window.Worker = class extends Plain {
          constructor(url) {
            const start = `const early = []; self.onmessage = (event) => early.push(event); ${text};
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
    ['gives nothing', ''],
  ]) {
    test(`a browser whose decoder ${kind} says so, and does not load for ever`, async (t) => {
      if (!hasFfmpeg()) return skip(t, 'ffmpeg', 'there is no ffmpeg');
      const room = `mute-${kind.length}`;
      const publisher = publish(room, film(`${room}.h264`, { filters: 'format=yuv420p' }));
      const { page, context } = await openPage(browser, STILL);
      await decoding(page, script);
      await page.goto(`${server.url}/live/${room}`);
      await page.getByText('This browser cannot show the video of this room').waitFor();
      assert.ok(await page.getByText('Loading…').isHidden());
      publisher.stop();
      await context.close();
    });
  }
});
