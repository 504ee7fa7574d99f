// Uses every control of the pages. Fails if a page has a control without a step, or a step has no control.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, waitForMode } from '../support/browser.mjs';
import { boxContainer } from '../support/container.mjs';
import { serve } from '../support/fake-server.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { waitForStill, until as waitUntil } from '../support/until.mjs';

const EMULATOR = createRequire(import.meta.url).resolve('iwer/build/iwer.min.js');
/** A touch device on which all controls appear. */
const EVERYTHING = {
  hasTouch: true,
  isMobile: true,
  viewport: { width: 700, height: 800 },
  acceptDownloads: true,
};

/** Names of all controls, visible or not. */
function controls(page) {
  return page.evaluate(() =>
    [...document.querySelectorAll('a, button, input, select, summary, [tabindex]')].map((element) => {
      const text = (from) => from?.textContent.trim().replace(/\s+/g, ' ');
      const labelled = element.getAttribute('aria-label') || text(document.getElementById(element.getAttribute('aria-labelledby')));
      return `${element.localName}: ${labelled || text(element.labels?.[0]) || text(element) || element.id}`;
    }),
  );
}

/** Runs the steps in order; every control must have exactly one step. */
async function runSteps(page, steps) {
  assert.deepEqual([...new Set(await controls(page))].toSorted(), Object.keys(steps).toSorted(), 'every control has a step');
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

  test('of the photo page works', async () => {
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
      waitUntil(
        () => viewer(f),
        () => f.toString(),
      );
    const menu = (id) => page.evaluate((name) => document.getElementById(name).matches(':popover-open'), id);
    const opensMenu = (button, id) => async () => {
      await button.click();
      assert.ok(await menu(id), 'the menu opens');
    };
    const selectsOverlay = (name) => async () => {
      await page.locator(`input[value=${name}]`).check();
      assert.equal(await viewer((v) => v.overlay), name);
    };
    const linksTo = (locator, path) => async () =>
      assert.equal(
        new URL(await locator.getAttribute('href'), server.url).pathname + new URL(await locator.getAttribute('href'), server.url).search,
        path,
      );
    const assertSaved = (count) => assert.equal(server.patches.length, count);
    assertSaved(0);
    await runSteps(page, {
      'a: All photos': async () => {
        // one link is in the bar, one in the error message
        for (const link of await page.locator('a[href="/"]').all()) assert.equal(await link.getAttribute('href'), '/');
      },
      'div: The box': async () => {
        await $('stage').focus();
        await page.keyboard.press('ArrowRight');
        await until((v) => v.pose.tx > 0.002);
      },
      'button: Reset': async () => {
        await $('reset').click();
        await waitForStill(page, { when: ({ pose }) => pose.tx === 0 });
      },
      'button: Motion': async () => {
        await $('idle').click();
        assert.ok(await viewer((v) => v.idle));
        await $('idle').click();
        assert.ok(!(await viewer((v) => v.idle)));
      },
      'button: Show': opensMenu($('show'), 'show-menu'),
      'select: For both eyes': async () => {
        assert.ok(await $('eyes').isHidden());
        await $('stereo').selectOption('crossed');
        assert.equal(await viewer((v) => v.stereo), 'crossed');
      },
      'input: Distance between the eyes': async () => {
        await $('eyes').fill('2');
        assert.equal(await viewer((v) => v.eyeDistance), 2 / 30);
        await $('stereo').selectOption('');
        assert.ok(await $('eyes').isHidden());
        assert.equal(await viewer((v) => v.stereo), '');
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
      'input: Depth': selectsOverlay('depth'),
      'summary: How it is made': async () => {
        await page.locator('#inner summary').click();
        assert.match(await $('facts').textContent(), /^200 × 120 · [\d.]+ kB · [\d.]+ ms$/);
        assert.equal(await $('readout').textContent(), '', 'the readout stays empty');
      },
      'input: Tiles': selectsOverlay('tiles'),
      'input: Planes': selectsOverlay('planes'),
      'input: Error: red is a pixel of parallax or more': selectsOverlay('error'),
      'input: The photo': selectsOverlay('none'),
      'button: Look around in a headset': async () => {
        await $('headset').click();
        await until((v) => v.headset?.frames > 0);
        await viewer((v) => v.headset.end());
        await until((v) => !v.headset);
        await page.keyboard.press('Escape');
      },
      'button: Settings': opensMenu($('settings'), 'settings-menu'),
      'input: Title': async () => {
        await $('set-title').fill('Another');
        assert.ok(await $('set-save').isEnabled(), 'Save is enabled while typing');
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
        await waitForStill(page); // back from the orbit
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
        assertSaved(1);
        assert.equal(await $('title').textContent(), 'Another');
      },
      'button: Back to how it was': async () => {
        await $('set-clear').click();
        assert.equal(await $('set-title').inputValue(), 'Another', 'reset keeps the title');
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
      'button: Download': opensMenu(page.locator('[popovertarget=download-menu]'), 'download-menu'),
      'a: The 3D photo (.tmpi)': linksTo($('download'), '/v1/photos/box/atlas'),
      'a: A page for any browser (.html)': linksTo(page.locator('[data-export=html]'), '/v1/photos/box/export?format=html'),
      'a: A 3D model (.glb)': linksTo(page.locator('[data-export=glb]'), '/v1/photos/box/export?format=glb'),
      'a: Layers for Krita or GIMP (.ora)': linksTo(page.locator('[data-export=ora]'), '/v1/photos/box/export?format=ora'),
      'button: This view (.png)': async () => {
        const [download] = await Promise.all([page.waitForEvent('download'), $('picture').click()]);
        assert.equal(download.suggestedFilename(), 'Another.png');
        await page.keyboard.press('Escape');
      },
      'a: For red and cyan glasses (.jpg)': async () => {
        await page.locator('[popovertarget=download-menu]').click();
        const pivot = await viewer((v) => v.pivot.toFixed(3));
        await linksTo(page.locator('[data-view=anaglyph]'), `/v1/photos/box/view?stereo=anaglyph&format=jpeg&focus=${pivot}`)();
        assert.equal(await page.locator('[data-view=anaglyph]').getAttribute('download'), 'Another-anaglyph.jpg');
      },
      'a: Two views side by side (.jpg)': async () => {
        assert.match(await page.locator('[data-view=sbs]').getAttribute('href'), /\/v1\/photos\/box\/view\?stereo=sbs&/);
      },
      'a: A stereo photo for 3D displays (.mpo)': async () => {
        assert.match(await page.locator('[data-view=mpo]').getAttribute('href'), /\?stereo=sbs&format=mpo&/);
        assert.equal(await page.locator('[data-view=mpo]').getAttribute('download'), 'Another.mpo');
      },
      'a: For a light-field display (.png)': async () => {
        assert.match(await page.locator('[data-view=quilt]').getAttribute('href'), /\?quilt=8x6&w=420&h=560&format=png&/);
        assert.match(await page.locator('[data-view=quilt]').getAttribute('download'), /_qs8x6a0\.75\.png$/);
      },
      'a: The depth map (.png)': async () => {
        await linksTo($('depth-download'), '/v1/photos/box/depth')();
        await page.keyboard.press('Escape');
      },
      'button: Share': opensMenu($('share'), 'share-menu'),
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
      // last, because clicks miss afterwards on an emulated screen
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
        assert.deepEqual(server.deleted, [], 'undo prevents the deletion');
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

  test('pages fit any screen width in both languages', async () => {
    server.state.settings = { version: 1, title: 'A name that is long enough to fill a line of its own, and then some more of it' };
    for (const locale of ['en', 'de']) {
      const { page, context } = await openPage(browser, { locale });
      for (const path of ['/view/box', '/']) {
        await page.goto(server.url + path);
        if (path.startsWith('/view')) await page.waitForFunction(() => !document.getElementById('settings').hidden);
        for (const width of [320, 360, 480, 600, 641, 720, 800, 901, 1024, 1280]) {
          await page.setViewportSize({ width, height: 700 });
          const beyond = await page.evaluate(async () => {
            // the viewer resizes its pictures in the next frame
            await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
            const shown = [...document.body.querySelectorAll('*')].filter(
              (e) => e.checkVisibility({ visibilityProperty: true }) && e.getBoundingClientRect().right > innerWidth + 0.5,
            );
            return [
              ...(document.documentElement.scrollWidth > innerWidth ? ['page'] : []),
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

  test('of the gallery page works', async () => {
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
    let reject = false;
    await page.route('**/v1/photos*', async (route) => {
      if (route.request().method() !== 'POST') {
        const second = route.request().url().includes('after');
        return route.fulfill({ json: second ? { photos: [photo('older')] } : { photos: [photo('box')], next: '/v1/photos?after=1' } });
      }
      bodies.push(route.request().postDataBuffer().toString('latin1'));
      if (reject) return route.fulfill({ status: 415, json: { detail: 'This is no picture.' } });
      return route.fulfill({ status: 202, json: photo('new') });
    });
    await page.route('**/thumbnail', (route) => route.fulfill({ contentType: 'image/png', body: boxPhoto(60, 40) }));
    let pending = null;
    await page.route('**/events', async (route) => {
      if (pending) await pending;
      return route.fulfill({ contentType: 'text/event-stream', body: 'event: done\ndata: {}\n\n' });
    });
    await page.goto(`${server.url}/`);
    const card = page.getByRole('link', { name: 'Open box' });
    await card.waitFor();
    const $ = (id) => page.locator(`#${id}`);
    const file = (name) => ({ name, mimeType: 'image/png', buffer: Buffer.from(name) });
    const sent = async (count) => {
      await waitUntil(() => bodies.length >= count);
      return bodies.at(-1);
    };
    await runSteps(page, {
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
        // wait until the controls of the upload's row are gone
        await page.getByRole('link', { name: 'Open one.png' }).waitFor();
      },
      'input: Take a photo': async () => {
        assert.ok(await page.getByText('Take a photo').isVisible());
        assert.equal(await $('camera').getAttribute('capture'), 'environment');
        let finish;
        pending = new Promise((resume) => (finish = resume));
        await $('camera').setInputFiles([file('shot.png')]);
        assert.match(await sent(2), /filename="shot.png"/);
        await page.getByRole('button', { name: 'Cancel shot.png' }).click();
        await page.getByText('shot.png', { exact: true }).waitFor({ state: 'detached' });
        assert.deepEqual(server.deleted, ['/v1/photos/new']);
        finish();
        pending = null;
      },
      // presets.test.mjs chooses one
      'select: Preset of the next photos': async () => assert.ok(await $('preset').isHidden()),
      'select: Quality of the next photos': async () => {
        await $('quality').selectOption('small');
        await $('picker').setInputFiles([file('two.png')]);
        const body = await sent(3);
        assert.match(body, /name="quality"\r\n\r\n75\r\n/);
        assert.match(body, /name="max-error"\r\n\r\n4\r\n/);
      },
      'input: Your own depth map, for one photo (a grey picture, near is bright; best a 16-bit PNG)': async () => {
        await $('depth-map').setInputFiles([file('map.png')]);
        reject = true;
        await $('picker').setInputFiles([file('three.png')]);
        assert.match(await sent(4), /name="depth"; filename="map.png"/);
        await page.getByText('This is no picture.', { exact: true }).waitFor();
        await page.getByRole('button', { name: 'Dismiss three.png' }).click();
        await page.getByText('three.png', { exact: true }).waitFor({ state: 'detached' });
      },
      'input: Second eye, for one photo (a picture taken from beside it, which tells depth)': async () => {
        await $('second-eye').setInputFiles([file('right.png')]);
        await $('picker').setInputFiles([file('four.png')]);
        assert.match(await sent(5), /name="second"; filename="right.png"/);
        await page.getByText('This is no picture.', { exact: true }).waitFor();
        await page.getByRole('button', { name: 'Dismiss four.png' }).click();
        await page.getByText('four.png', { exact: true }).waitFor({ state: 'detached' });
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
        // a click on the picture selects it instead of opening it
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
      // installed.test.mjs presses it
      'button: Notify me': async () => assert.ok(await $('uploads-notify').isHidden()),
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
