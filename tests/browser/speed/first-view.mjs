// Measures the time from navigation to the first 3D view over a slow link: a proxy limits the rate of all connections to the server together.
import { readFileSync } from 'node:fs';
import { connect, createServer } from 'node:net';
import { launch } from '../support/browser.mjs';
import { makePhoto, startServer } from '../support/program.mjs';

/**
 * A proxy that delays both directions by half the round trip, and limits the rate of responses.
 * @param {number} port of the server
 * @param {{mbps: number, latency: number}} link megabits per second, round trip in ms
 */
async function slowProxy(port, { mbps, latency }) {
  const bytesPerMs = (mbps * 1e6) / 8 / 1000;
  let lineFree = 0;
  const sendAt = (socket, data, at) => setTimeout(() => socket.writable && socket.write(data), at - performance.now());
  const sockets = new Set();
  const proxy = createServer((client) => {
    const server = connect(port, '127.0.0.1');
    client.on('data', (data) => sendAt(server, data, performance.now() + latency / 2));
    server.on('data', (data) => {
      lineFree = Math.max(lineFree, performance.now() + latency / 2) + data.length / bytesPerMs;
      sendAt(client, data, lineFree);
    });
    for (const [one, other] of [
      [client, server],
      [server, client],
    ]) {
      sockets.add(one);
      one.setNoDelay();
      one.on('error', () => other.destroy());
      one.on('close', () => setTimeout(() => other.destroy(), Math.max(lineFree - performance.now(), 0) + latency));
    }
  });
  await new Promise((ready) => proxy.listen(0, '127.0.0.1', ready));
  const close = () => {
    for (const socket of sockets) socket.destroy();
    proxy.close();
  };
  return { port: proxy.address().port, close };
}

/** In the page, before its scripts: records when the photo arrives, the scene is uploaded, and the GPU has drawn it. */
function recordTimes() {
  const times = {};
  window.firstView = new Promise((done) => {
    const poll = () => {
      const { viewer } = window;
      if (!viewer) return void setTimeout(poll, 1);
      viewer.addEventListener('photo', () => (times.photo = performance.now()));
      viewer.addEventListener('ready', async ({ detail }) => {
        times.ready = performance.now();
        await viewer.renderer?.idle();
        done({ ...times, drawn: performance.now(), mode: detail.mode });
      });
    };
    poll();
  });
}

/**
 * Measures each run in a new browser.
 * @param {string} photo file
 * @param {{mbps: number, latency: number, runs: number, webgpu: boolean}} options
 */
export async function firstViews(photo, { runs, webgpu, ...link }) {
  const server = await startServer();
  const { id } = await makePhoto(server.url, readFileSync(photo));
  const proxy = await slowProxy(Number(new URL(server.url).port), link);
  const times = [];
  try {
    for (let run = 0; run < runs; run++) {
      const browser = await launch({ webgpu });
      const page = await browser.newPage({ viewport: { width: 1280, height: 800 } });
      await page.addInitScript(recordTimes);
      await page.goto(`http://127.0.0.1:${proxy.port}/view/${id}`);
      times.push(await page.evaluate(() => window.firstView));
      await browser.close();
    }
  } finally {
    proxy.close();
    await server.close();
  }
  return times;
}
