// A walk through every control of the pages. What a page has and the walk does not is a failure, and so is the reverse.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, waitForMode } from '../support/browser.mjs';
import { boxContainer } from '../support/container.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { serve } from '../support/static-server.mjs';
import { until as come } from '../support/until.mjs';

const EMULATOR = createRequire(import.meta.url).resolve('iwer/build/iwer.min.js');
/** A finger, and a browser in which all controls are offered. */
const EVERYTHING = {
  reducedMotion: 'reduce',
  hasTouch: true,
  isMobile: true,
  viewport: { width: 700, height: 800 },
  acceptDownloads: true,
};

/** Names of all controls, shown or not. */
function controls(page) {
  return page.evaluate(() =>
    [...document.querySelectorAll('a, button, input, select, summary, [tabindex]')].map((element) => {
      const text = (from) => from?.textContent.trim().replace(/\s+/g, ' ');
      const labelled = element.getAttribute('aria-label') || text(document.getElementById(element.getAttribute('aria-labelledby')));
      return `${element.localName}: ${labelled || text(element.labels?.[0]) || text(element) || element.id}`;
    }),
  );
}

/** Takes the steps in their order; every control is named by one of them and by no other. */
async function walk(page, steps) {
  assert.deepEqual([...new Set(await controls(page))].toSorted(), Object.keys(steps).toSorted(), 'the walk knows all controls');
  for (const [name, step] of Object.entries(steps)) {
    await step().catch((error) => {
      throw new Error(`${name}: ${error.message}`, { cause: error });
    });
  }
}

describe('every control', () => {
  let server;
  let browser;
  before(async () => {
    server = await serve({ atlas: boxContainer() });
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  test('of the page of one photo', async () => {
    const { page, context, errors } = await openPage(browser, EVERYTHING);
    await page.addInitScript(`${readFileSync(EMULATOR, 'utf8')}
      window.headset = new IWER.XRDevice(IWER.metaQuest3);
      window.headset.installRuntime({ forceInstall: true });
      window.sharing = null;
      navigator.share = async (what) => { window.sharing = what; };`);
    server.state.settings = { version: 1, title: 'The box' };
    Object.assign(server.state, { visibility: 'private', links: {} });
    await page.goto(`${server.url}/view/box`);
    await waitForMode(page, 'gpu');
    await page.waitForFunction(() => document.title.startsWith('The box') && !document.getElementById('headset').hidden);
    const $ = (id) => page.locator(`#${id}`);
    const viewer = (f) => page.evaluate(`(${f})(window.viewer)`);
    const until = (f) =>
      come(
        () => viewer(f),
        () => f.toString(),
      );
    const menu = (id) => page.evaluate((name) => document.getElementById(name).matches(':popover-open'), id);
    const opens = (button, id) => async () => {
      await button.click();
      assert.ok(await menu(id), 'opens its menu');
    };
    const overlay = (name) => async () => {
      await page.locator(`input[value=${name}]`).check();
      assert.equal(await viewer((v) => v.overlay), name);
    };
    const answers = (locator, path) => async () =>
      assert.equal(
        new URL(await locator.getAttribute('href'), server.url).pathname + new URL(await locator.getAttribute('href'), server.url).search,
        path,
      );
    const saves = (count) => () => assert.equal(server.patches.length, count);
    saves(0)();
    await walk(page, {
      'a: All photos': async () => {
        // twice: in the bar, and where the photo cannot be shown
        for (const link of await page.locator('a[href="/"]').all()) assert.equal(await link.getAttribute('href'), '/');
      },
      'div: The box': async () => {
        await $('stage').focus();
        await page.keyboard.press('ArrowRight');
        await until((v) => v.pose.tx > 0.002);
      },
      'button: Reset': async () => {
        await $('reset').click();
        await until((v) => !v.moving && v.pose.tx === 0);
      },
      'button: Motion': async () => {
        await $('idle').click();
        assert.ok(await viewer((v) => v.idle));
        await $('idle').click();
        assert.ok(!(await viewer((v) => v.idle)));
      },
      'button: Show': opens($('show'), 'show-menu'),
      'input: Side by side for stereo viewers': async () => {
        await $('stereo').check();
        assert.ok(await viewer((v) => v.stereo));
        await $('stereo').uncheck();
        assert.ok(!(await viewer((v) => v.stereo)));
      },
      'input: Move by tilting the device': async () => {
        await $('tilt').check();
        await until((v) => v.tilting);
        await $('tilt').uncheck();
        await until((v) => !v.tilting);
      },
      'input: Blur of what is out of focus': async () => {
        assert.ok(await $('blur-hint').isHidden());
        await $('blur').fill('0.5');
        assert.equal(await viewer((v) => v.blur), 0.5);
        assert.ok(await $('blur-hint').isVisible());
        await $('blur').fill('0');
      },
      'input: Depth': overlay('depth'),
      'summary: How it is made': async () => {
        await page.locator('#inner summary').click();
        assert.match(await $('facts').textContent(), /^200 × 120 · [\d.]+ kB · [\d.]+ ms$/);
        assert.equal(await $('readout').textContent(), '', 'the title is nobody’s instrument');
      },
      'input: Tiles': overlay('tiles'),
      'input: Planes': overlay('planes'),
      'input: Error: red is a pixel of parallax or more': overlay('error'),
      'input: The photo': overlay('none'),
      'button: Look around in a headset': async () => {
        await $('headset').click();
        await until((v) => v.headset?.frames > 0);
        await viewer((v) => v.headset.end());
        await until((v) => !v.headset);
        await page.keyboard.press('Escape');
      },
      'button: Settings': opens($('settings'), 'settings-menu'),
      'input: Title': async () => {
        await $('set-title').fill('Another');
        assert.ok(await $('set-save').isEnabled(), 'while it is typed');
        await $('set-title').press('Tab');
      },
      'input: How far it moves': async () => {
        await $('set-motion').fill('0.5');
        assert.ok(Math.abs((await viewer((v) => v.limits.x)) - 0.015) < 1e-4);
      },
      'select: How it moves by itself': async () => {
        await $('set-idle').selectOption('orbit');
        assert.ok(await viewer((v) => v.idle && v.motion.style === 'orbit' && v.settings.idle === 'orbit'));
        await $('set-idle').selectOption('none');
        assert.ok(await viewer((v) => !v.idle));
      },
      'input: How fast': async () => {
        await $('set-speed').fill('2');
        assert.deepEqual(await viewer((v) => [v.motion.rate, v.settings.speed]), [2, 2]);
      },
      'input: What stays still: far to near': async () => {
        await $('set-focus').fill('0.7');
        assert.equal(await viewer((v) => v.pivot), 0.7);
      },
      'button: Begin with this view': async () => {
        await until((v) => !v.moving); // home from the orbit
        await $('set-start').click();
        assert.deepEqual(await viewer((v) => v.settings.start), { x: 0, y: 0, z: 0 });
      },
      'button: Show this view in the list': async () => {
        await $('set-poster').click();
        assert.deepEqual(await viewer((v) => v.settings.poster), { x: 0, y: 0, z: 0 });
      },
      'button: Save with the photo': async () => {
        await $('set-save').click();
        await page.getByText('Saved', { exact: true }).waitFor();
        saves(1)();
        assert.equal(await $('title').textContent(), 'Another');
      },
      'button: Back to how it was': async () => {
        await $('set-clear').click();
        assert.equal(await $('set-title').inputValue(), 'Another', 'what a photo is called is not how it moves');
        assert.deepEqual(await viewer((v) => v.settings), { version: 1, title: 'Another' });
        await page.keyboard.press('Escape');
      },
      'button: Touch up the depth…': async () => {
        await $('settings').click();
        await $('touch-up').click();
        await page.getByRole('dialog', { name: 'Touch up the depth' }).waitFor();
        await $('touch-cancel').click();
        await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
      },
      'button: Download': opens(page.locator('[popovertarget=download-menu]'), 'download-menu'),
      'a: The 3D photo (.tmpi)': answers($('download'), '/v1/photos/box/atlas'),
      'a: A page for any browser (.html)': answers(page.locator('[data-export=html]'), '/v1/photos/box/export?format=html'),
      'a: A 3D model (.glb)': answers(page.locator('[data-export=glb]'), '/v1/photos/box/export?format=glb'),
      'a: Layers for Krita or GIMP (.ora)': answers(page.locator('[data-export=ora]'), '/v1/photos/box/export?format=ora'),
      'button: This view (.png)': async () => {
        const [download] = await Promise.all([page.waitForEvent('download'), $('picture').click()]);
        assert.equal(download.suggestedFilename(), 'Another.png');
        await page.keyboard.press('Escape');
      },
      'a: For red and cyan glasses (.jpg)': async () => {
        await page.locator('[popovertarget=download-menu]').click();
        const pivot = await viewer((v) => v.pivot.toFixed(3));
        await answers(page.locator('[data-view=anaglyph]'), `/v1/photos/box/view?stereo=anaglyph&format=jpeg&focus=${pivot}`)();
        assert.equal(await page.locator('[data-view=anaglyph]').getAttribute('download'), 'Another-anaglyph.jpg');
      },
      'a: Two views side by side (.jpg)': async () => {
        assert.match(await page.locator('[data-view=sbs]').getAttribute('href'), /\/v1\/photos\/box\/view\?stereo=sbs&/);
      },
      'a: For a light-field display (.png)': async () => {
        assert.match(await page.locator('[data-view=quilt]').getAttribute('href'), /\?quilt=8x6&w=420&h=560&format=png&/);
        assert.match(await page.locator('[data-view=quilt]').getAttribute('download'), /_qs8x6a0\.75\.png$/);
      },
      'a: The depth map (.png)': async () => {
        await answers($('depth-download'), '/v1/photos/box/depth')();
        await page.keyboard.press('Escape');
      },
      'button: Share': opens($('share'), 'share-menu'),
      'button: A film or GIF…': async () => {
        await $('share-film').click();
        const dialog = page.getByRole('dialog', { name: 'A film or GIF' });
        await dialog.getByRole('button', { name: 'Make it' }).waitFor();
        await dialog.getByRole('button', { name: 'Close' }).click();
        await dialog.waitFor({ state: 'detached' });
      },
      'button: Put it on a page…': async () => {
        await $('share').click();
        await $('share-embed').click();
        const dialog = page.getByRole('dialog', { name: 'Put it on a page' });
        assert.match(
          await dialog.getByLabel('In a frame', { exact: true }).inputValue(),
          /<iframe src="[^"]*\/embed\/box" title="Another"/,
        );
        await dialog.getByRole('button', { name: 'Close' }).click();
        await dialog.waitFor({ state: 'detached' });
      },
      'button: Who may see it…': async () => {
        await $('share').click();
        await $('share-access').click();
        const dialog = page.getByRole('dialog', { name: 'Who may see it' });
        await dialog.getByLabel('A link with an end date', { exact: true }).waitFor();
        await dialog.getByRole('button', { name: 'Close' }).click();
        await dialog.waitFor({ state: 'detached' });
      },
      'button: Link to this view': async () => {
        await $('share').click();
        await $('share-link').click();
        const dialog = page.getByRole('dialog', { name: 'Link to this view' });
        await dialog.getByRole('button', { name: 'Let anyone with the link see it' }).click();
        await dialog.getByText('Anyone with the link can see it.').waitFor();
        await dialog.getByRole('button', { name: 'Close' }).click();
        await $('share').click();
        await $('share-link').click();
        await page.waitForFunction(() => window.sharing?.url === location.href.split('#')[0]);
      },
      'input: Link to this view': async () => {
        await page.evaluate(() => {
          navigator.share = () => Promise.reject(new Error('no'));
          Object.defineProperty(navigator, 'clipboard', { value: undefined });
        });
        await $('share').click();
        await $('share-link').click();
        assert.equal(await $('link').inputValue(), `${server.url}/view/box`);
      },
      'button: Close': async () => {
        await page.getByRole('button', { name: 'Close' }).click();
        assert.ok(await $('link-dialog').isHidden());
      },
      // last: where a screen is only emulated, clicks go astray afterwards
      'button: Tilt to look around': async () => {
        assert.ok(await $('tilt-offer').isHidden());
        await $('stage').tap();
        await $('tilt-offer').click();
        await until((v) => v.tilting);
        await viewer((v) => v.setTilt(false));
      },
      'button: Full screen': async () => {
        await $('fullscreen').click();
        await page.waitForFunction(() => document.fullscreenElement === document.documentElement);
        await page.evaluate(() => document.exitFullscreen());
        await page.waitForFunction(() => document.getElementById('fullscreen').getAttribute('aria-pressed') === 'false');
      },
      'button: Delete the photo': async () => {
        const other = await context.newPage();
        await other.goto(`${server.url}/view/box`);
        await waitForMode(other, 'gpu');
        await other.locator('#settings').click();
        await other.locator('#delete').click();
        await other.getByRole('button', { name: 'Undo' }).click();
        assert.equal(new URL(other.url()).pathname, '/');
        await other.close();
        assert.deepEqual(server.deleted, [], 'what was undone is not deleted');
      },
      'button: Try again': async () => {
        const lost = await context.newPage();
        await lost.goto(`${server.url}/view/nowhere`);
        const [again] = await Promise.all([lost.waitForEvent('load'), lost.getByRole('button', { name: 'Try again' }).click()]);
        assert.ok(again);
        await lost.close();
      },
    });
    assert.deepEqual(errors, []);
    await context.close();
    Object.assign(server.state, { settings: undefined, visibility: undefined, links: undefined });
  });

  test('at no width the page is wider than the screen, in both languages', async () => {
    server.state.settings = { version: 1, title: 'A name that is long enough to fill a line of its own, and then some more of it' };
    for (const locale of ['en', 'de']) {
      const { page, context } = await openPage(browser, { reducedMotion: 'reduce', locale });
      for (const path of ['/view/box', '/']) {
        await page.goto(server.url + path);
        if (path.startsWith('/view')) await page.waitForFunction(() => !document.getElementById('settings').hidden);
        for (const width of [320, 360, 480, 600, 641, 720, 800, 901, 1024, 1280]) {
          await page.setViewportSize({ width, height: 700 });
          const beyond = await page.evaluate(async () => {
            // the viewer lays its pictures out within the frame that sees the new size
            await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
            const shown = [...document.body.querySelectorAll('*')].filter(
              (e) => e.checkVisibility({ visibilityProperty: true }) && e.getBoundingClientRect().right > innerWidth + 0.5,
            );
            return [
              ...(document.documentElement.scrollWidth > innerWidth ? ['the page'] : []),
              ...shown.map((e) => `${e.localName} ${e.id} ${e.className}`),
            ];
          });
          assert.deepEqual(beyond, [], `${path} in ${locale} at ${width} pixels`);
        }
      }
      await context.close();
    }
    server.state.settings = undefined;
  });

  test('of the page of all photos', async () => {
    const { page, context, errors } = await openPage(browser, EVERYTHING);
    const photo = (id) => ({
      id,
      state: 'done',
      created: '2026-03-04T05:06:07Z',
      width: 30,
      height: 20,
      atlas_bytes: 1500,
      settings: { version: 1, title: id },
    });
    const bodies = [];
    let refuse = false;
    await page.route('**/v1/photos*', async (route) => {
      if (route.request().method() !== 'POST') {
        const second = route.request().url().includes('after');
        return route.fulfill({ json: second ? { photos: [photo('older')] } : { photos: [photo('box')], next: '/v1/photos?after=1' } });
      }
      bodies.push(route.request().postDataBuffer().toString('latin1'));
      if (refuse) return route.fulfill({ status: 415, json: { detail: 'This is no picture.' } });
      return route.fulfill({ status: 202, json: photo('new') });
    });
    await page.route('**/thumbnail', (route) => route.fulfill({ contentType: 'image/png', body: boxPhoto(60, 40) }));
    let going = null;
    await page.route('**/events', async (route) => {
      if (going) await going;
      return route.fulfill({ contentType: 'text/event-stream', body: 'event: done\ndata: {}\n\n' });
    });
    await page.goto(`${server.url}/`);
    const card = page.getByRole('link', { name: 'Open box' });
    await card.waitFor();
    const $ = (id) => page.locator(`#${id}`);
    const file = (name) => ({ name, mimeType: 'image/png', buffer: Buffer.from(name) });
    const sent = async (count) => {
      await come(() => bodies.length >= count);
      return bodies.at(-1);
    };
    await walk(page, {
      'a: tmpi': async () => assert.equal(await page.locator('.brand').getAttribute('href'), '/'),
      'summary: Options': async () => {
        await page.locator('summary').click();
        assert.ok(await $('quality').isVisible());
      },
      'input: Choose photos': async () => {
        await $('picker').setInputFiles([file('one.png')]);
        const body = await sent(1);
        assert.match(body, /name="photo"; filename="one.png"/);
        assert.doesNotMatch(body, /name="quality"/);
        // the row's controls come and go with it
        await page.getByRole('link', { name: 'Open one.png' }).waitFor();
      },
      'input: Take a photo': async () => {
        assert.ok(await page.getByText('Take a photo').isVisible());
        assert.equal(await $('camera').getAttribute('capture'), 'environment');
        let arrive;
        going = new Promise((resume) => (arrive = resume));
        await $('camera').setInputFiles([file('shot.png')]);
        assert.match(await sent(2), /filename="shot.png"/);
        await page.getByRole('button', { name: 'Cancel shot.png' }).click();
        await page.getByText('shot.png', { exact: true }).waitFor({ state: 'detached' });
        assert.deepEqual(server.deleted, ['/v1/photos/new']);
        arrive();
        going = null;
      },
      'select: Quality of the next photos': async () => {
        await $('quality').selectOption('small');
        await $('picker').setInputFiles([file('two.png')]);
        const body = await sent(3);
        assert.match(body, /name="quality"\r\n\r\n75\r\n/);
        assert.match(body, /name="max-error"\r\n\r\n4\r\n/);
      },
      'input: Your own depth map, for one photo (a grey picture, near is bright; best a 16-bit PNG)': async () => {
        await $('depth-map').setInputFiles([file('map.png')]);
        refuse = true;
        await $('picker').setInputFiles([file('three.png')]);
        assert.match(await sent(4), /name="depth"; filename="map.png"/);
        await page.getByText('This is no picture.', { exact: true }).waitFor();
        await page.getByRole('button', { name: 'Dismiss three.png' }).click();
        await page.getByText('three.png', { exact: true }).waitFor({ state: 'detached' });
      },
      'a: Open box': async () => assert.equal(await card.getAttribute('href'), '/view/box'),
      'button: Delete box': async () => {
        await page.getByRole('button', { name: 'Delete box' }).click();
        await card.waitFor({ state: 'hidden' });
        await page.getByRole('button', { name: 'Undo' }).click();
        await card.waitFor();
      },
      'button: Show more': async () => {
        await $('more').click();
        await page.getByRole('link', { name: 'Open older' }).waitFor();
        assert.ok(await $('more').isHidden());
      },
      'button: Select': async () => {
        await $('select').click();
        assert.ok(await $('selection-delete').isDisabled());
        await page.getByRole('checkbox', { name: 'Choose older' }).check();
        await page.getByText('1 of 2 chosen').waitFor();
        // a click on the picture marks it, and opens nothing
        await card.click();
        await page.getByText('2 of 2 chosen').waitFor();
      },
      'button: All': async () => {
        await $('selection-all').click();
        await page.getByText('Choose photos to delete').waitFor();
        await $('selection-all').click();
        await page.getByText('2 of 2 chosen').waitFor();
      },
      'button: Delete': async () => {
        await $('selection-delete').click();
        await page.getByText('2 photos deleted').waitFor();
        await card.waitFor({ state: 'hidden' });
        await page.getByRole('button', { name: 'Undo' }).click();
        await card.waitFor();
      },
      'button: Done': async () => {
        await $('select').click();
        await $('selection-done').click();
        assert.equal(await page.getByRole('checkbox').count(), 0);
      },
      'button: Cancel all': async () => assert.ok(await $('uploads-cancel').isHidden()),
      'button: Dismiss failed': async () => assert.ok(await $('uploads-dismiss').isHidden()),
      'a: Go live with your camera': async () =>
        assert.match(await page.locator('#go-live').getAttribute('href'), /^\/live\/[a-z]{8}\/publish$/),
      'a: 3D photos on a page': async () => assert.equal(await page.locator('a[href="/demo"]').count(), 1),
    });
    assert.deepEqual(
      errors.filter((e) => !/favicon|415/.test(e)),
      [],
    );
    await context.close();
  });
});
