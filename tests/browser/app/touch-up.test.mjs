// Touch-up of depth with the built program: the server applies what the user paints.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { filePixels, fractionDifferent, launch, openPage, pixelsAt, seriousViolations, waitForMode } from '../support/browser.mjs';
import { BOX, boxPhoto, inBox, png16 } from '../support/pictures.mjs';
import { makePhoto, startServer } from '../support/program.mjs';

const WIDTH = 320;
const HEIGHT = 200;
/** Disparity of the whole photo: the box is wrongly as far as the wall. */
const WALL = 0.3;

/** Intersection over union of two masks. */
function overlap(a, b) {
  let both = 0;
  let either = 0;
  for (let i = 0; i < WIDTH * HEIGHT; i++) {
    both += a(i) && b(i) ? 1 : 0;
    either += a(i) || b(i) ? 1 : 0;
  }
  return both / either;
}

describe('touch-up', () => {
  let server;
  let browser;
  before(async () => {
    server = await startServer();
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  /** Uploads a new photo and opens its page: `{page, context, errors, id, depth}`. */
  async function opened(shade, options = { viewport: { width: 960, height: 600 } }) {
    const made = await makePhoto(
      server.url,
      boxPhoto(WIDTH, HEIGHT),
      // makes each photo unique
      png16(WIDTH, HEIGHT, (x, y) => WALL + (x === 0 && y === 0 ? shade : 0)),
    );
    const all = await openPage(browser, options);
    await all.page.goto(`${server.url}/view/${made.id}`);
    await waitForMode(all.page, 'gpu');
    /** The server's disparity, 0 to 255 per pixel. */
    const depth = async () => (await filePixels(all.page, `/v1/photos/${made.id}/depth`)).filter((_, i) => i % 4 === 0);
    return { ...all, id: made.id, depth };
  }

  async function start(page) {
    await page.locator('#settings').click();
    await page.getByRole('button', { name: 'Touch up the depth…' }).click();
    await page.locator('dialog.touch-up').waitFor();
  }

  const strokes = async (page, id) => (await page.evaluate(async (url) => (await fetch(url)).json(), `/v1/photos/${id}/strokes`)).strokes;

  /** Paints through positions, as fractions of the photo. */
  async function paint(page, places) {
    const box = await page.locator('#touch-photo').boundingBox();
    const to = ([x, y]) => [box.x + x * box.width, box.y + y * box.height];
    await page.mouse.move(...to(places[0]));
    await page.mouse.down();
    for (const place of places.slice(1)) await page.mouse.move(...to(place), { steps: 8 });
    await page.mouse.up();
  }

  const slide = (page, id, value) =>
    page.locator(id).evaluate((input, v) => {
      input.value = String(v);
      input.dispatchEvent(new Event('input', { bubbles: true }));
      input.dispatchEvent(new Event('change', { bubbles: true }));
    }, value);

  /** Brightness of the depth preview at a position. */
  const previewed = (page, [x, y]) =>
    page.locator('#touch-depth').evaluate(
      async (canvas, [px, py]) => {
        // changes appear in the next frame
        await new Promise((resume) => requestAnimationFrame(() => requestAnimationFrame(resume)));
        return canvas.getContext('2d').getImageData(px * canvas.width, py * canvas.height, 1, 1).data[0];
      },
      [x, y],
    );

  const wholePreview = (page) =>
    page.locator('#touch-depth').evaluate(async (canvas) => {
      await new Promise((resume) => requestAnimationFrame(() => requestAnimationFrame(resume)));
      const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
      return [...data.filter((_, i) => i % 4 === 0)];
    });

  const middle = [(BOX.x0 + BOX.x1) / 2, (BOX.y0 + BOX.y1) / 2];
  const along = [
    [BOX.x0 + 0.05, middle[1]],
    [BOX.x1 - 0.05, middle[1]],
  ];

  test('painting brings the box nearer up to its edges', async () => {
    const { page, context, errors, id, depth } = await opened(0.01);
    const address = page.url();
    const version = await page.evaluate(async (url) => (await (await fetch(url)).json()).version, `/v1/photos/${id}`);
    const aside = () => pixelsAt(page, { tx: 0.03 }, WIDTH, HEIGHT);
    const flat = await aside();
    await start(page);
    assert.deepEqual(await seriousViolations(page), []);
    assert.ok(await page.locator('#touch-save').isDisabled(), 'Save is disabled without strokes');
    await slide(page, '#touch-size', 0.16);
    await paint(page, along);
    await slide(page, '#touch-amount', 0.5);
    assert.ok(Math.abs((await previewed(page, middle)) - 255 * (WALL + 0.5)) < 3, 'the preview follows the slider');
    assert.ok(Math.abs((await previewed(page, [0.05, 0.05])) - 255 * WALL) < 3, 'the wall stays');
    const preview = await wholePreview(page);
    await page.locator('#touch-save').click();
    await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
    await page.locator('#toast.on').waitFor();
    await waitForMode(page, 'gpu');
    assert.equal(page.url(), address);
    const after = await page.evaluate(async (url) => (await fetch(url)).json(), `/v1/photos/${id}`);
    assert.ok(after.state === 'done' && after.version !== version);

    const map = await depth();
    const near = (value) => value > 255 * (WALL + 0.25);
    const box = overlap(
      (i) => near(map[i]),
      (i) => inBox(i % WIDTH, Math.floor(i / WIDTH), WIDTH, HEIGHT),
    );
    assert.ok(box > 0.95, `${box} of the box`);
    const same = overlap(
      (i) => near(map[i]),
      (i) => near(preview[i]),
    );
    assert.ok(same > 0.97, `the server and the preview overlap by ${same}`);
    // the box now moves against the wall
    await page.waitForFunction(() => window.viewer?.renderer);
    const deep = await aside();
    const inner = { x0: BOX.x0 + 0.05, x1: BOX.x1 - 0.05, y0: BOX.y0 + 0.05, y1: BOX.y1 - 0.05 };
    const moved = fractionDifferent(flat, deep, WIDTH, HEIGHT, inner);
    const stood = fractionDifferent(flat, deep, WIDTH, HEIGHT, { x0: 0.05, x1: 0.25, y0: 0.05, y1: 0.95 });
    assert.ok(moved > 0.5 && stood < 0.02, `${moved} of the box and ${stood} of the wall moved`);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('new strokes add to saved ones, which are applied once', async () => {
    const { page, context, errors, id, depth } = await opened(0.05);
    const painted = async (by) => {
      await slide(page, '#touch-size', 0.16);
      await paint(page, along);
      await slide(page, '#touch-amount', by);
    };
    const save = async () => {
      await page.locator('#touch-save').click();
      await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
      await page.locator('#settings').waitFor();
    };
    await start(page);
    await painted(0.3);
    await save();
    await start(page);
    assert.ok(Math.abs((await previewed(page, middle)) - 255 * (WALL + 0.3)) < 3, 'the preview starts with the saved strokes');
    await painted(0.2);
    assert.ok(Math.abs((await previewed(page, middle)) - 255 * (WALL + 0.5)) < 3);
    const preview = await wholePreview(page);
    await save();
    assert.equal((await strokes(page, id)).length, 2);
    const map = await depth();
    const near = (value) => value > 255 * (WALL + 0.4);
    const same = overlap(
      (i) => near(map[i]),
      (i) => near(preview[i]),
    );
    assert.ok(same > 0.95, `the server and the preview overlap by ${same}`);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('saved strokes can be undone and changed one by one', async () => {
    const { page, context, errors, id, depth } = await opened(0.06);
    const radius = 0.16;
    const wide = { points: along, radius, by: 0.3 };
    const [corner, sky] = [
      { points: [[0.12, 0.15]], radius: 0.1, by: 0.25 },
      { points: [[0.88, 0.15]], radius: 0.1, to: 0 },
    ];
    const status = await page.evaluate(
      async ([url, all]) => {
        const headers = { 'content-type': 'application/json', prefer: 'wait=20' };
        return (await fetch(url, { method: 'PATCH', headers, body: JSON.stringify({ strokes: all }) })).status;
      },
      [`/v1/photos/${id}/strokes`, [wide, corner, sky]],
    );
    assert.equal(status, 200);
    await page.reload();
    await waitForMode(page, 'gpu');
    const save = async () => {
      await page.locator('#touch-save').click();
      await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
      await page.locator('#settings').waitFor();
    };
    /** Fraction of preview pixels within 4 levels of the server's map. */
    const agrees = async (preview) => {
      const map = await depth();
      return preview.filter((value, i) => Math.abs(value - map[i]) <= 4).length / map.length;
    };
    const near = async (place, value) => Math.abs((await previewed(page, place)) - 255 * value) < 3;

    await start(page);
    assert.ok(await page.locator('#touch-save').isDisabled(), 'Save is disabled without changes');
    const begun = await wholePreview(page);
    const same = await agrees(begun);
    assert.ok(same > 0.98, `the preview starts with the saved depth: ${same}`);
    assert.ok((await near(middle, WALL + 0.3)) && (await near([0.12, 0.15], WALL + 0.25)) && (await near([0.88, 0.15], 0)));
    // undo removes the newest stroke first
    await page.locator('#touch-undo').click();
    assert.ok(await near([0.88, 0.15], WALL), 'the wall is back at its depth');
    // the slider now changes the stroke before
    await slide(page, '#touch-amount', 0.4);
    assert.ok(await near([0.12, 0.15], WALL + 0.4));
    await page.locator('#touch-undo').click();
    await page.locator('#touch-undo').click();
    assert.ok((await near([0.12, 0.15], WALL)) && (await near(middle, WALL)), 'all three strokes are undone');
    assert.ok(await page.locator('#touch-undo').isDisabled());
    for (const _ of [1, 2, 3]) await page.locator('#touch-redo').click();
    assert.deepEqual(await wholePreview(page), begun);
    assert.ok(await page.locator('#touch-save').isDisabled(), 'Save is disabled after redo');
    await page.locator('#touch-undo').click();
    await page.locator('#touch-undo').click();
    const preview = await wholePreview(page);
    assert.ok((await near(middle, WALL + 0.3)) && (await near([0.12, 0.15], WALL)));
    await save();
    assert.deepEqual(await strokes(page, id), [wide]);
    const share = await agrees(preview);
    assert.ok(share > 0.98, `the preview equals the server's map on ${share}`);

    // remove all strokes and paint on the original depth
    await start(page);
    await page.locator('#touch-clear').click();
    assert.equal(
      await page.locator('#touch-status').textContent(),
      'Paint over what is at the wrong depth. The paint stops at edges in the photo.',
    );
    assert.ok(await near(middle, WALL));
    await slide(page, '#touch-size', radius);
    await paint(page, along);
    await slide(page, '#touch-amount', 0.5);
    const other = await wholePreview(page);
    await save();
    assert.equal((await strokes(page, id))[0].by, 0.5);
    const again = await agrees(other);
    assert.ok(again > 0.98, `the preview equals the server's map on ${again}`);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('undo, redo, cancel and remove all', async () => {
    const { page, context, errors, id, depth } = await opened(0.02);
    const untouched = await depth();
    await start(page);
    await slide(page, '#touch-amount', 0.4);
    await paint(page, along);
    const painted = await previewed(page, middle);
    assert.ok(painted > 150);
    await page.locator('#touch-undo').click();
    assert.ok(Math.abs((await previewed(page, middle)) - 255 * WALL) < 3);
    assert.ok(await page.locator('#touch-save').isDisabled());
    await page.keyboard.press('Control+Shift+Z');
    assert.equal(await previewed(page, middle), painted);
    await page.keyboard.press('Control+Z');
    await page.locator('#touch-redo').click();
    assert.equal(await previewed(page, middle), painted);
    // as far as the sky, then as near as another position
    await page.getByLabel('Far away, like the sky').check();
    await paint(page, [[0.1, 0.1]]);
    assert.equal(await previewed(page, [0.1, 0.1]), 0);
    await page.getByLabel('As near as a place').check();
    await paint(page, [[0.9, 0.9]]);
    assert.ok(await page.locator('#touch-save').isDisabled(), 'Save is disabled until a place is chosen');
    assert.match(await page.locator('#touch-status').textContent(), /choose a place/);
    await paint(page, [middle]);
    assert.equal(await previewed(page, [0.9, 0.9]), painted);
    await page.locator('#touch-cancel').click();
    await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
    assert.deepEqual(await strokes(page, id), []);

    await start(page);
    await paint(page, along);
    await page.locator('#touch-save').click();
    await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
    assert.equal((await strokes(page, id)).length, 1);
    await page.locator('#settings').waitFor();
    await start(page);
    await page.locator('#touch-clear').click();
    await page.locator('#touch-save').click();
    await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
    assert.deepEqual(await strokes(page, id), []);
    assert.deepEqual(await depth(), untouched);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('works by keyboard', async () => {
    const { page, context, errors, id } = await opened(0.03);
    await start(page);
    await page.locator('#touch-photo').focus();
    // start a stroke, move right, end the stroke
    await page.keyboard.press('Space');
    for (let i = 0; i < 4; i++) await page.keyboard.press('ArrowRight');
    await page.keyboard.press('Space');
    for (const _ of [1, 2]) await page.keyboard.press('Shift+ArrowDown');
    await page.keyboard.press('Enter');
    await page.keyboard.press('Enter');
    await page.locator('#touch-save').focus();
    await page.keyboard.press('Enter');
    await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
    const [line, dab] = await strokes(page, id);
    assert.deepEqual([line.points[0], line.points.at(-1)[0] > 0.57, line.points.at(-1)[1]], [[0.5, 0.5], true, 0.5]);
    assert.ok(dab.points.length === 1 && dab.points[0][1] > 0.51 && dab.points[0][1] < 0.52, `${dab.points}`);
    await start(page);
    await page.keyboard.press('Escape');
    await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('works by touch, and reports a conflicting change', async () => {
    const phone = { hasTouch: true, isMobile: true, viewport: { width: 360, height: 740 } };
    const { page, context, errors, id } = await opened(0.04, phone);
    await start(page);
    const wide = await page.evaluate(() => document.querySelector('dialog.touch-up').scrollWidth);
    assert.ok(wide <= 360, `${wide} pixels wide`);
    const box = await page.locator('#touch-photo').boundingBox();
    const client = await context.newCDPSession(page);
    const at = ([x, y]) => [{ x: box.x + x * box.width, y: box.y + y * box.height }];
    await client.send('Input.dispatchTouchEvent', { type: 'touchStart', touchPoints: at(along[0]) });
    for (const share of [0.25, 0.5, 0.75, 1]) {
      const x = along[0][0] + share * (along[1][0] - along[0][0]);
      await client.send('Input.dispatchTouchEvent', { type: 'touchMove', touchPoints: at([x, middle[1]]) });
    }
    await client.send('Input.dispatchTouchEvent', { type: 'touchEnd', touchPoints: [] });
    assert.ok((await previewed(page, middle)) > 255 * WALL + 20);
    const other = await page.evaluate(async (url) => {
      const headers = { 'content-type': 'application/json', prefer: 'wait=20' };
      const body = JSON.stringify({ strokes: [{ points: [[0.1, 0.1]], radius: 0.1, to: 0 }] });
      return (await fetch(url, { method: 'PATCH', headers, body })).status;
    }, `/v1/photos/${id}/strokes`);
    assert.equal(other, 200);
    await page.locator('#touch-save').click();
    await page.waitForFunction(() =>
      /Somebody changed the photo in the meantime/.test(document.getElementById('touch-status').textContent),
    );
    assert.ok(await page.locator('#touch-save').isEnabled(), 'the strokes are still there');
    assert.deepEqual(
      errors.filter((e) => !/412/.test(e)),
      [],
    );
    await context.close();
  });
});
