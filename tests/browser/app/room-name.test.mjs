// A room's name: a fresh one for whoever goes live, and another where somebody writes one.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { freshName, publishPage } from '../../../static/app/room-name.js';
import { roomSuite } from '../support/room.mjs';

test('fresh names differ and can be said', () => {
  const names = new Set(Array.from({ length: 500 }, freshName));
  assert.equal(names.size, 500);
  for (const name of names) assert.match(publishPage(name), /^\/live\/(?:[bdfgklmnprstvz][aeiou]){4}\/publish$/);
});

describe('the page of who publishes', () => {
  const suite = roomSuite();

  test('says before the start that a room is taken, and goes to another', async () => {
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
