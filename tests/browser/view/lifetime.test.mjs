// Many viewers open and close without a leak.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

const CYCLES = 20;
/** Allowed heap growth per cycle in bytes, for requests and garbage that the browser keeps. */
const HEAP_BYTES = 20_000;

describe('viewer lifetime', () => {
  const suite = boxSuite();

  test(`${CYCLES} viewers leave no GPU objects and memory behind`, async (t) => {
    const { page, context, errors } = await openPage(suite.browser);
    await page.addInitScript(() => {
      // counts live GPU objects
      window.alive = { textures: 0, buffers: 0, devices: 0 };
      const counted = (key, make) =>
        function (...args) {
          const made = make.apply(this, args);
          window.alive[key]++;
          const destroy = made.destroy.bind(made);
          let gone = false;
          made.destroy = () => {
            if (!gone) window.alive[key]--;
            gone = true;
            destroy();
          };
          return made;
        };
      const { prototype } = GPUDevice;
      prototype.createTexture = counted('textures', prototype.createTexture);
      prototype.createBuffer = counted('buffers', prototype.createBuffer);
      const { requestDevice } = GPUAdapter.prototype;
      GPUAdapter.prototype.requestDevice = async function (...args) {
        const device = await requestDevice.apply(this, args);
        window.alive.devices++;
        device.lost.then(() => window.alive.devices--);
        return device;
      };
    });
    await page.goto(`${suite.server.url}/embed?host=${suite.server.url}`);
    const cdp = await context.newCDPSession(page);
    const cycle = () =>
      page.evaluate(async () => {
        const element = document.createElement('tmpi-viewer');
        element.setAttribute('src', '/v1/photos/box/atlas');
        element.setAttribute('loading', 'eager');
        element.style.width = '300px';
        const ready = new Promise((resolve) => element.addEventListener('load', resolve, { once: true }));
        document.body.append(element);
        const { detail } = await ready;
        const { device } = element.viewer.renderer;
        element.remove();
        // Chromium collects a device that nothing refers to before it is lost, and with it all who wait for that.
        window.closing = device;
        await device.lost;
        window.closing = null;
        return detail.mode;
      });
    const heap = async () => {
      await cdp.send('HeapProfiler.collectGarbage');
      const { usedSize } = await cdp.send('Runtime.getHeapUsage');
      const { nodes, jsEventListeners } = await cdp.send('Memory.getDOMCounters');
      return { usedSize, nodes, jsEventListeners };
    };
    await page.evaluate(() => document.querySelector('tmpi-viewer').remove());
    for (let i = 0; i < 5; i++) assert.equal(await cycle(), 'gpu');
    const before = await heap();
    for (let i = 0; i < CYCLES; i++) await cycle();
    const after = await heap();
    assert.deepEqual(await page.evaluate(() => window.alive), { textures: 0, buffers: 0, devices: 0 });
    const grown = (after.usedSize - before.usedSize) / CYCLES;
    t.diagnostic(
      `heap ${before.usedSize} → ${after.usedSize} bytes, ${Math.round(grown)} per cycle; nodes ${before.nodes} → ${after.nodes}, listeners ${before.jsEventListeners} → ${after.jsEventListeners}`,
    );
    assert.ok(grown < HEAP_BYTES, `${grown} bytes per cycle`);
    assert.ok(after.nodes - before.nodes < CYCLES, `nodes ${before.nodes} → ${after.nodes}`);
    assert.ok(
      after.jsEventListeners - before.jsEventListeners < CYCLES,
      `listeners ${before.jsEventListeners} → ${after.jsEventListeners}`,
    );
    assert.deepEqual(
      errors.filter((e) => !e.includes('favicon')),
      [],
    );
    await context.close();
  });
});
