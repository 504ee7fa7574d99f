// What opens must close: nothing is left behind after many viewers; and the controls that no other test presses.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, seriousViolations, waitForMode } from './browser.mjs';
import { boxScene, container } from './fixture.mjs';
import { serve } from './static-server.mjs';

const CYCLES = 50;
/** Bytes a cycle that the heap may grow by: what the browser itself keeps of requests and of its garbage's order. */
const HEAP_BYTES = 20_000;

describe('life', () => {
  let server;
  let browser;
  before(async () => {
    server = await serve({ atlas: container(boxScene(200, 120)) });
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  test(`${CYCLES} viewers open and close, and leave neither graphics objects nor memory behind`, async (t) => {
    const { page, context, errors } = await openPage(browser, { reducedMotion: 'reduce' });
    await page.addInitScript(() => {
      // counts what is made and destroyed
      window.alive = { textures: 0, buffers: 0, devices: 0 };
      const counted = (kind, key, make) =>
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
      prototype.createTexture = counted('texture', 'textures', prototype.createTexture);
      prototype.createBuffer = counted('buffer', 'buffers', prototype.createBuffer);
      const { requestDevice } = GPUAdapter.prototype;
      GPUAdapter.prototype.requestDevice = async function (...args) {
        const device = await requestDevice.apply(this, args);
        window.alive.devices++;
        device.lost.then(() => window.alive.devices--);
        return device;
      };
    });
    await page.goto(`${server.url}/embed?host=${server.url}`);
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
        await device.lost;
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
    t.diagnostic(`heap ${before.usedSize} → ${after.usedSize} bytes, ${Math.round(grown)} a cycle; nodes ${before.nodes} → ${after.nodes}, listeners ${before.jsEventListeners} → ${after.jsEventListeners}`);
    assert.ok(grown < HEAP_BYTES, `${grown} bytes a cycle`);
    assert.ok(after.nodes - before.nodes < CYCLES, `nodes ${before.nodes} → ${after.nodes}`);
    assert.ok(after.jsEventListeners - before.jsEventListeners < CYCLES, `listeners ${before.jsEventListeners} → ${after.jsEventListeners}`);
    assert.deepEqual(errors.filter((e) => !e.includes('favicon')), []);
    await context.close();
  });

  test('tilting the device moves the camera, from the first posture on, and stops with the box', async () => {
    const { page, context, errors } = await openPage(browser, { reducedMotion: 'reduce', hasTouch: true });
    await page.goto(`${server.url}/view/box`);
    await waitForMode(page, 'gpu');
    await page.locator('#show').click();
    const box = page.getByLabel('Move by tilting');
    await box.check();
    const tilt = (beta, gamma) => page.evaluate(([b, g]) => dispatchEvent(new DeviceOrientationEvent('deviceorientation', { beta: b, gamma: g })), [beta, gamma]);
    const settled = () => page.waitForFunction(() => !window.viewer.moving);
    const pose = () => page.evaluate(() => window.viewer.pose);
    // the browser is asked first, which takes its time
    await page.waitForFunction(() => window.viewer.tilting);
    await tilt(40, 10);
    await settled();
    assert.ok(Math.abs((await pose()).tx) < 1e-4, 'the first posture is the middle');
    await tilt(40, 20);
    await page.waitForFunction(() => window.viewer.pose.tx > 0.01);
    await tilt(30, 10);
    await page.waitForFunction(() => window.viewer.pose.ty < -0.01);
    await settled();
    const last = await pose();
    const stage = await page.locator('#stage').boundingBox();
    await page.mouse.move(stage.x + 20, stage.y + 20);
    await page.mouse.move(stage.x + 60, stage.y + 40);
    await page.waitForTimeout(100);
    assert.deepEqual(await pose(), last, 'a mouse that hovers does not fight the tilt');
    await box.uncheck();
    await tilt(70, 60);
    await page.waitForTimeout(200);
    assert.deepEqual(await pose(), last);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the settings of a photo are obeyed, tried and saved', async () => {
    const { page, context, errors } = await openPage(browser, { reducedMotion: 'reduce' });
    server.state.settings = { version: 1, title: 'The box', motion: { x: 0.5, y: 1, z: 1 }, start: { x: 0.5, y: 0, z: 0 }, focus: 0.6 };
    await page.goto(`${server.url}/view/box`);
    await waitForMode(page, 'gpu');
    assert.equal(await page.locator('#title').textContent(), 'The box');
    // half the view box of 0.03 to the right is as far as it goes, and where it starts
    await page.waitForFunction(() => Math.abs(window.viewer.pose.tx - 0.015) < 1e-3);
    assert.equal(await page.evaluate(() => window.viewer.pivot), 0.6);
    await page.locator('#stage').focus();
    for (let i = 0; i < 20; i++) await page.keyboard.press('ArrowRight');
    await page.waitForFunction(() => !window.viewer.moving);
    assert.ok((await page.evaluate(() => window.viewer.pose.tx)) <= 0.015);
    await page.locator('#settings').click();
    assert.deepEqual(await seriousViolations(page), []);
    await page.getByLabel('Title').fill('Another box');
    await page.getByLabel('How far it moves').fill('1');
    await page.getByRole('button', { name: 'Save with the photo' }).click();
    await page.getByText('Saved', { exact: true }).waitFor();
    assert.equal(await page.locator('#title').textContent(), 'Another box');
    const [{ headers, body }] = server.patches;
    assert.equal(headers['if-match'], '"1"');
    assert.deepEqual(JSON.parse(body), { title: 'Another box', motion: null });
    assert.ok(await page.evaluate(() => window.viewer.limits.x > 0.029));
    assert.deepEqual(errors, []);
    await context.close();
    server.state.settings = undefined;
  });

  test('the error of each tile is shown', async () => {
    const { page, context, errors } = await openPage(browser, { reducedMotion: 'reduce' });
    await page.goto(`${server.url}/view/box`);
    await waitForMode(page, 'gpu');
    for (const webgl of [false, true]) {
      if (webgl) {
        // the second host shows the same
        for (let i = 0; i < 2; i++) {
          await page.evaluate(() => {
            window.lost = window.viewer.renderer;
            window.lost.device.destroy();
          });
          await page.waitForFunction(() => window.viewer.renderer && window.viewer.renderer !== window.lost);
        }
        await waitForMode(page, 'webgl');
      } else {
        await page.locator('#show').click();
        await page.getByLabel('Error').check();
      }
      const colours = () =>
        page.evaluate(async () => {
          const [w, h] = [200, 120];
          window.viewer.setPose({});
          const data = await window.viewer.readPixels(w, h);
          return [[10, 10], [190, 110]].map(([x, y]) => [...data.subarray((y * w + x) * 4, (y * w + x) * 4 + 3)]);
        });
      await page.waitForFunction(async () => {
        const data = await window.viewer.readPixels(200, 120);
        return data[0] < data[1];
      });
      const [first, last] = await colours();
      assert.ok(first[1] > first[0] + 60, `the first tile has no error and is green: ${first}`);
      assert.ok(last[0] > last[1] + 60, `the last has a pixel and is red: ${last}`);
    }
    assert.deepEqual(errors, []);
    await context.close();
  });
});
