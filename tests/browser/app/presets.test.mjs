// Presets of the server, which the pages offer by name.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { seriousViolations, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

const presets = [
  { name: 'card', kind: 'view' },
  { name: 'loop', kind: 'film' },
  { name: 'small', kind: 'photo' },
];

describe('presets of photos', () => {
  const suite = uploadSuite();

  test('a preset is sent in place of a quality, which is hidden where only presets are taken', async () => {
    for (const only of [false, true]) {
      suite.server.state.presets = { presets, only };
      const posts = ['a', 'b'].map((id) => ({ status: 202, json: photo(id) }));
      const { page, context, bodies } = await suite.open({ posts });
      const upload = async (name) => {
        await page.setInputFiles('#picker', { name, mimeType: 'image/png', buffer: Buffer.from('x') });
        await page.getByRole('link', { name: `Open ${name}` }).waitFor();
      };
      await page.locator('summary').click();
      const preset = page.getByLabel('Preset of the next photos');
      const quality = page.getByLabel('Quality of the next photos');
      await preset.waitFor();
      assert.deepEqual(await preset.locator('option').allTextContents(), ['None', 'small']);
      assert.equal(await quality.isVisible(), !only);
      if (!only) await quality.selectOption('best');
      await preset.selectOption('small');
      assert.ok(await quality.isHidden());
      assert.deepEqual(await seriousViolations(page), []);
      await upload('one.png');
      await preset.selectOption({ label: 'None' });
      assert.equal(await quality.isVisible(), !only);
      await upload('two.png');
      assert.match(bodies[0], /name="preset"\r\n\r\nsmall\r\n/);
      assert.doesNotMatch(bodies[0], /name="quality"/);
      assert.doesNotMatch(bodies[1], /name="preset"/);
      assert.equal(/name="quality"/.test(bodies[1]), !only);
      await context.close();
    }
  });
});

describe('presets of views and films', () => {
  const suite = boxSuite();

  test('the download menu links to them, and hides what is refused', async () => {
    suite.server.state.settings = { version: 1, title: 'The box v1.5' };
    for (const only of [false, true]) {
      suite.server.state.presets = { presets, only };
      const { page, context, errors } = await suite.open();
      await waitForMode(page, 'gpu');
      await page.waitForFunction(() => document.title.startsWith('The box'));
      await page.locator('[popovertarget=download-menu]').click();
      const menu = page.locator('#download-menu');
      const links = menu.locator('#preset-downloads a');
      await links.nth(1).waitFor();
      const told = await links.evaluateAll((all) => all.map((a) => [a.textContent, a.getAttribute('href'), a.download]));
      assert.deepEqual(told, [
        ['A picture: card', '/v1/photos/box/view?preset=card', 'The-box-v1-5-card'],
        ['A film: loop', '/v1/photos/box/view?preset=loop', 'The-box-v1-5-loop'],
      ]);
      assert.equal(await menu.locator('[data-view]:visible').count(), only ? 0 : 4);
      for (const name of ['A 3D model (.glb)', 'The depth map (.png)']) assert.ok(await menu.getByRole('link', { name }).isVisible());
      assert.deepEqual(errors, []);
      await context.close();
    }
  });
});
