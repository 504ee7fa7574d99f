// Room names: a new one for each publisher, and the form to change it.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { at } from '../../../static/app/dom.js';
import { freshName, publishPage } from '../../../static/app/room-name.js';
import { roomSuite } from '../support/room.mjs';

test('new names are unique and pronounceable', () => {
  const names = new Set(Array.from({ length: 500 }, freshName));
  assert.equal(names.size, 500);
  for (const name of names) {
    assert.match(name, /^(?:[bdfgklmnprstvz][aeiou]){4}$/);
    assert.equal(publishPage(name), at(`/live/${name}/publish`));
  }
});

describe('the publisher’s page', () => {
  const suite = roomSuite();

  test('warns if the room is taken, and switches to another', async () => {
    const first = await suite.publish('taken');
    const second = await suite.camera.newContext({ permissions: ['camera', 'microphone'] });
    const page = await second.newPage();
    await page.goto(`${suite.server.url}/live/taken/publish`);
    await page.getByText('Somebody is live in this room already.').waitFor();
    const name = page.getByLabel('Name of the room');
    assert.equal(await name.inputValue(), 'taken');
    await name.fill('not a name');
    await page.getByRole('button', { name: 'Start' }).click();
    assert.equal(await page.evaluate(() => location.pathname), '/live/taken/publish');
    await name.fill('free');
    await page.getByRole('button', { name: 'Start' }).click();
    await page.waitForFunction(() => document.body.dataset.state === 'live');
    assert.equal(await page.evaluate(() => location.pathname), '/live/free/publish');
    assert.equal(await page.locator('#link').inputValue(), `${suite.server.url}/live/free`);
    await page.getByText('for this machine only').waitFor();
    await second.close();
    await first.context.close();
  });
});
