// The page as an installed app: its manifest, photos that other apps share with it, and notifications.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { evaluateBytes, filePixels, fractionDifferent, launch, openPage } from '../support/browser.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { startServer } from '../support/program.mjs';
import { gate, until } from '../support/until.mjs';

describe('the installed page', () => {
  let server;
  let browser;
  before(async () => {
    server = await startServer(['--access', 'private']);
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  /** Opens the page of all photos and waits for its worker. */
  async function open(prepare = async () => {}) {
    const opened = await openPage(browser);
    await prepare(opened);
    await opened.page.goto(`${server.url}/`);
    await opened.page.waitForFunction(async () => (await navigator.serviceWorker.getRegistrations())[0]?.active);
    return opened;
  }
  const names = async (page) => {
    const { photos } = await page.evaluate(async () => (await fetch('/v1/photos')).json());
    return photos.map(({ settings }) => settings.title).toSorted();
  };

  test('has a valid manifest with icons of the stated sizes', async () => {
    const { page, context, errors } = await open();
    const session = await context.newCDPSession(page);
    const { url, errors: problems, data } = await session.send('Page.getAppManifest');
    assert.deepEqual([new URL(url).pathname, problems], ['/static/app/manifest.json', []]);
    assert.match((await fetch(url)).headers.get('content-type'), /^application\/json/);
    const { icons, start_url: start, share_target: target } = JSON.parse(data);
    assert.equal(new URL(start, url).href, `${server.url}/`);
    assert.equal(
      new URL(target.action, url).href,
      await page.evaluate(async () => (await navigator.serviceWorker.getRegistrations())[0].scope),
    );
    assert.ok(icons.some(({ sizes, type }) => type === 'image/png' && Number.parseInt(sizes, 10) >= 512));
    for (const { src, sizes, type } of icons) {
      const address = new URL(src, url).href;
      assert.equal((await fetch(address)).headers.get('content-type'), type, src);
      if (type !== 'image/png') continue;
      const size = Number(sizes.split('x')[0]);
      const own = await filePixels(page, address);
      assert.equal(own.length, size * size * 4, src);
      // as the vector icon is drawn
      const drawn = await evaluateBytes(
        page,
        async ([vector, side]) => {
          const image = new Image(side, side);
          image.src = vector;
          await image.decode();
          const canvas = Object.assign(document.createElement('canvas'), { width: side, height: side });
          const pen = canvas.getContext('2d');
          pen.drawImage(image, 0, 0, side, side);
          return pen.getImageData(0, 0, side, side).data;
        },
        [new URL('icon.svg', url).href, size],
      );
      const off = fractionDifferent(own, drawn, size, size);
      assert.ok(off < 0.01, `${src} differs from icon.svg in ${off} of its pixels`);
    }
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('uploads shared photos once, as if they were chosen there', async () => {
    const { page, context } = await open();
    // Android posts this form
    await page.evaluate(() => {
      document.body.innerHTML = `<form method="post" enctype="multipart/form-data" action="/static/app/share/">
        <input name="photo" type="file" multiple /></form>`;
    });
    const file = (name, buffer) => ({ name, mimeType: 'image/png', buffer });
    const shared = [
      file('the “sea” & I.png', boxPhoto(60, 40)),
      file('two.png', boxPhoto(40, 60)),
      file('none.png', Buffer.from('no picture')),
    ];
    await page.setInputFiles('input', shared);
    await page.evaluate(() => document.querySelector('form').submit());
    await page.waitForURL(`${server.url}/`);
    await page.locator('.upload.failed').getByText('none.png').waitFor();
    await page.locator('#gallery .card').nth(1).waitFor();
    assert.deepEqual(await names(page), ['the “sea” & I', 'two']);
    assert.deepEqual(await page.evaluate(() => caches.keys()), []);
    await page.reload();
    await page.locator('#gallery .card').nth(1).waitFor();
    assert.ok(await page.locator('#uploads').isHidden(), 'nothing is uploaded again');
    await context.close();
  });

  test('notifies of a photo that is ready while the page is hidden, after a click', async () => {
    const made = gate();
    const { page, context } = await open(async ({ page, context }) => {
      await context.grantPermissions(['notifications']);
      // the user has not decided until the click
      await page.addInitScript(() => {
        let permission = 'default';
        Object.defineProperty(Notification, 'permission', { get: () => permission });
        Notification.requestPermission = async () => (permission = 'granted');
      });
      await page.route('**/v1/photos/*/events', async (route) => {
        await made.opened;
        await route.fulfill({ contentType: 'text/event-stream', body: 'event: done\ndata: {}\n\n' });
      });
    });
    const button = page.getByRole('button', { name: 'Notify me' });
    assert.ok(await button.isHidden(), 'nothing is under way');
    await page.setInputFiles('#picker', { name: 'three.png', mimeType: 'image/png', buffer: boxPhoto(50, 50) });
    await button.click();
    await button.waitFor({ state: 'hidden' });
    await page.evaluate(() => Object.defineProperty(document, 'hidden', { value: true }));
    made.open();
    const told = () =>
      page.evaluate(async () => {
        const [registration] = await navigator.serviceWorker.getRegistrations();
        return (await registration.getNotifications()).map(({ title, data }) => [title, data]);
      });
    await until(async () => (await told()).length === 1);
    const [[title, address]] = await told();
    assert.equal(title, 'three.png is ready.');
    assert.match(address, /^\/view\/[0-9a-f]{32}$/);
    await context.close();
  });
});
