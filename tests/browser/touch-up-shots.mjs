// Pictures of a photo whose depth is wrong and is put right by hand, wide and on a phone, and the seconds that it takes. Not a test; run by hand:
//   node touch-up-shots.mjs FOLDER
// The photo is docs/sample.jpg, with the near car left at the wall behind it. A hand is not as fast as this: it is what the program takes of it.
import { mkdirSync, readFileSync } from 'node:fs';
import { join } from 'node:path';
import { launch, openPage, pixelsOf, waitForMode } from './support/browser.mjs';
import { png } from './support/pictures.mjs';
import { makePhoto, startServer } from './support/program.mjs';

const [folder] = process.argv.slice(2);
if (!folder) {
  console.error('usage: node touch-up-shots.mjs FOLDER');
  process.exit(2);
}
const [WIDTH, HEIGHT] = [1280, 720];
/** Outline of the car in pixels, and disparity that it was robbed of. */
const CAR = [
  [500, 431],
  [557, 404],
  [557, 346],
  [612, 333],
  [729, 329],
  [732, 371],
  [748, 371],
  [748, 440],
  [724, 514],
  [505, 508],
];
const LOST = 0.35;
/** What the brush goes over, in pixels: roof, windows, the side that faces the street, and the body. */
const LINE = [
  [610, 340],
  [718, 338],
  [718, 390],
  [574, 392],
  [574, 366],
  [700, 366],
  [738, 400],
  [735, 440],
  [712, 498],
  [520, 492],
  [522, 440],
  [690, 428],
  [690, 465],
];
const RADIUS = 0.02;
const SIZES = {
  wide: { viewport: { width: 1280, height: 800 } },
  phone: { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true, deviceScaleFactor: 2 },
};
/** As far to the left as the photo's view box goes. */
const LEFT = '#pose=-1,0,0';

const file = (name) => readFileSync(new URL(`../../docs/${name}`, import.meta.url));

/** Whether a point is within an outline: even or odd crossings to its right. */
function within(outline, x, y) {
  let inside = false;
  outline.forEach(([x1, y1], i) => {
    const [x0, y0] = outline.at(i - 1);
    if (y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0)) inside = !inside;
  });
  return inside;
}

/** The photo's map with the car at the wall. */
async function wrongMap(browser) {
  const { page, context } = await openPage(browser);
  const rgba = await pixelsOf(page, `data:image/png;base64,${file('sample_disparity.png').toString('base64')}`);
  await context.close();
  return png(WIDTH, HEIGHT, 1, (x, y) => [rgba[4 * (y * WIDTH + x)] - (within(CAR, x + 0.5, y + 0.5) ? 255 * LOST : 0)]);
}

const server = await startServer();
const browser = await launch();
try {
  mkdirSync(folder, { recursive: true });
  const made = await makePhoto(server.url, file('sample.jpg'), await wrongMap(browser));
  /** The photo's page from the left, at a size. */
  const opened = async (size) => {
    const all = await openPage(browser, { reducedMotion: 'reduce', ...SIZES[size] });
    await all.page.goto(`${server.url}/view/${made.id}${LEFT}`);
    await waitForMode(all.page, 'gpu');
    return all;
  };
  const keep = async (page, name) => {
    // sharper levels follow the first
    await page.waitForLoadState('networkidle');
    await page.waitForTimeout(3000);
    await page.screenshot({ path: join(folder, `${name}.png`) });
  };
  for (const size of Object.keys(SIZES)) {
    const { page, context } = await opened(size);
    await keep(page, `before-${size}`);
    await context.close();
  }

  const { page, context } = await opened('wide');
  const began = performance.now();
  await page.locator('#settings').click();
  await page.locator('#touch-up').click();
  await page.locator('dialog.touch-up').waitFor();
  const slide = (id, value) =>
    page.locator(id).evaluate((input, v) => {
      input.value = String(v);
      input.dispatchEvent(new Event('input', { bubbles: true }));
    }, value);
  await slide('#touch-size', RADIUS);
  const box = await page.locator('#touch-photo').boundingBox();
  const to = ([x, y]) => [box.x + (x / WIDTH) * box.width, box.y + (y / HEIGHT) * box.height];
  await page.mouse.move(...to(LINE[0]));
  await page.mouse.down();
  for (const place of LINE.slice(1)) await page.mouse.move(...to(place), { steps: 10 });
  await page.mouse.up();
  await slide('#touch-amount', LOST);
  await page.screenshot({ path: join(folder, 'touch-up.png') });
  await page.locator('#touch-save').click();
  await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
  const seconds = (performance.now() - began) / 1000;
  await context.close();

  for (const size of Object.keys(SIZES)) {
    const { page, context } = await opened(size);
    await keep(page, `after-${size}`);
    await context.close();
  }
  console.log(`from opening the touch-up to saved: ${seconds.toFixed(1)} s; pictures in ${folder}`);
} finally {
  await browser.close();
  await server.close();
}
