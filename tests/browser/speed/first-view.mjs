// Time from the start of navigation to the first view in three dimensions, over a link of a given rate: the program's own server behind a
// proxy that shapes what comes from it, for all connections together, and so for the page and its workers alike.
import { readFileSync } from 'node:fs';
import { connect, createServer } from 'node:net';
import { launch } from '../support/browser.mjs';
import { makePhoto, startServer } from '../support/program.mjs';

/**
 * A proxy: what comes from the server is late by half the round trip and as slow as the link, what goes to it late by the other half.
 * @param {number} port of the server
 * @param {{mbps: number, latency: number}} link megabits a second, round trip in ms
 */
async function shaped(port, { mbps, latency }) {
  const bytesPerMs = (mbps * 1e6) / 8 / 1000;
  let free = 0;
  const later = (socket, data, at) => setTimeout(() => socket.writable && socket.write(data), at - performance.now());
  const sockets = new Set();
  const proxy = createServer((client) => {
    const server = connect(port, '127.0.0.1');
    client.on('data', (data) => later(server, data, performance.now() + latency / 2));
    server.on('data', (data) => {
      free = Math.max(free, performance.now() + latency / 2) + data.length / bytesPerMs;
      later(client, data, free);
    });
    for (const [one, other] of [
      [client, server],
      [server, client],
    ]) {
      sockets.add(one);
      one.setNoDelay();
      one.on('error', () => other.destroy());
      one.on('close', () => setTimeout(() => other.destroy(), Math.max(free - performance.now(), 0) + latency));
    }
  });
  await new Promise((ready) => proxy.listen(0, '127.0.0.1', ready));
  const close = () => {
    for (const socket of sockets) socket.destroy();
    proxy.close();
  };
  return { port: proxy.address().port, close };
}

/** In the page, before its scripts: when the photo is there, the scene is handed to the device, and the device has drawn it. */
function watch() {
  const times = {};
  window.firstView = new Promise((done) => {
    const look = () => {
      const { viewer } = window;
      if (!viewer) return void setTimeout(look, 1);
      viewer.addEventListener('photo', () => (times.photo = performance.now()));
      viewer.addEventListener('ready', async ({ detail }) => {
        times.ready = performance.now();
        await viewer.renderer?.idle();
        done({ ...times, drawn: performance.now(), mode: detail.mode });
      });
    };
    look();
  });
}

/**
 * Times of all runs, each in a new browser.
 * @param {string} photo file
 * @param {{mbps: number, latency: number, runs: number, webgpu: boolean}} asked
 */
export async function firstViews(photo, { runs, webgpu, ...link }) {
  const server = await startServer();
  const { id } = await makePhoto(server.url, readFileSync(photo));
  const proxy = await shaped(Number(new URL(server.url).port), link);
  const times = [];
  try {
    for (let run = 0; run < runs; run++) {
      const browser = await launch({ webgpu });
      const page = await browser.newPage({ viewport: { width: 1280, height: 800 } });
      await page.addInitScript(watch);
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
