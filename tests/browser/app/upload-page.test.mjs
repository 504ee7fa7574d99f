// The gallery page with fake server responses.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { seriousViolations } from '../support/browser.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

describe('gallery page', () => {
  const suite = uploadSuite();

  test('shows a note when empty, and loads more pages', async () => {
    const empty = await suite.open({});
    await empty.page.getByText('No photo yet').waitFor();
    assert.ok(await empty.page.locator('#more').isHidden());
    await empty.context.close();
    const pages = [{ photos: [photo('a'), photo('b')], next: '/v1/photos?after=1' }, { photos: [photo('c')] }];
    const { page, context } = await suite.open({ pages });
    await page.locator('#more').click();
    await page.locator('.card').nth(2).waitFor();
    assert.ok(await page.locator('#more').isHidden());
    await context.close();
  });

  test('an upload waits as long as a busy server says', async () => {
    const posts = [
      { status: 429, headers: { 'retry-after': '1' }, contentType: 'application/problem+json', body: '{"detail":"64 photos wait"}' },
      { status: 202, json: { ...photo('a'), state: 'queued' } },
    ];
    const { page, context, sent } = await suite.open({ posts });
    await page.setInputFiles('#picker', { name: 'one.png', mimeType: 'image/png', buffer: Buffer.from('x') });
    await page.getByText('trying again in 1 s').waitFor();
    await page.getByRole('link', { name: 'Open one.png' }).waitFor();
    assert.equal(sent.length, 2);
    assert.ok(sent[1] - sent[0] >= 950, `${sent[1] - sent[0]} ms`);
    await context.close();
  });

  test('server errors become readable messages', async () => {
    const rejected = (status, detail) => ({ status, contentType: 'application/problem+json', body: JSON.stringify({ detail }) });
    const posts = [
      rejected(413, 'the request’s body is over the limit of 33554432 bytes'),
      rejected(400, 'photo: 9000×9000 is over the limit of 50000000 pixels'),
      rejected(412, 'the photo was changed meanwhile; it is "c377c1" now'),
      rejected(415, 'This is no picture.'),
    ];
    const { page, context } = await suite.open({ posts });
    for (const words of ['at most 34 MB', 'at most 50 million', 'Reload the page', 'This is no picture.']) {
      await page.setInputFiles('#picker', { name: 'one.png', mimeType: 'image/png', buffer: Buffer.from('x') });
      await page.locator('.upload-state').getByText(words).waitFor();
    }
    await context.close();
  });

  test('a depth map or a second eye applies to one photo, and the last choice counts', async () => {
    for (const [input, other, field] of [
      ['#depth-map', '#second-eye', 'depth'],
      ['#second-eye', '#depth-map', 'second'],
    ]) {
      const posts = [
        { status: 202, json: photo('a') },
        { status: 202, json: photo('b') },
      ];
      const { page, context, bodies } = await suite.open({ posts });
      await page.locator('summary').click();
      await page.setInputFiles(other, { name: 'other.png', mimeType: 'image/png', buffer: Buffer.from('other') });
      await page.setInputFiles(input, { name: 'map.png', mimeType: 'image/png', buffer: Buffer.from('depths') });
      for (const name of ['one.png', 'two.png']) {
        await page.setInputFiles('#picker', { name, mimeType: 'image/png', buffer: Buffer.from('x') });
        await page.getByRole('link', { name: `Open ${name}` }).waitFor();
      }
      assert.match(bodies[0], new RegExp(`name="${field}"; filename="map.png"`));
      for (const body of bodies) assert.doesNotMatch(body, /other\.png/);
      assert.doesNotMatch(bodies[1], /map\.png/);
      await context.close();
    }
  });

  test('has no serious accessibility violations', async () => {
    const { page, context } = await suite.open({ pages: [{ photos: [photo('a'), photo('b')] }] });
    await page.locator('.card').nth(1).waitFor();
    await page.locator('summary').click();
    for (const colorScheme of ['light', 'dark']) {
      await page.emulateMedia({ colorScheme });
      assert.deepEqual(await seriousViolations(page), []);
    }
    await context.close();
  });
});
