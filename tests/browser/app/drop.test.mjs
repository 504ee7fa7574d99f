// Dropped and pasted files.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { photo, uploadSuite } from '../support/upload-page.mjs';

describe('drop', () => {
  const suite = uploadSuite();
  /** Names of the uploaded files. */
  const names = (bodies) => bodies.map((body) => body.match(/filename="([^"]*)"/)[1]).sort();

  test('uploads dropped and pasted photos', async () => {
    const posts = [
      { status: 202, json: photo('a') },
      { status: 202, json: photo('b') },
      { status: 202, json: photo('c') },
    ];
    const { page, context, bodies } = await suite.open({ posts });
    await page.evaluate(() => {
      const files = new DataTransfer();
      for (const name of ['dropped.png', 'second.png']) files.items.add(new File(['x'], name, { type: 'image/png' }));
      const event = (type) => new DragEvent(type, { bubbles: true, cancelable: true, dataTransfer: files });
      document.body.dispatchEvent(event('dragenter'));
      if (!document.getElementById('drop').classList.contains('over')) throw new Error('the page does not highlight the drop zone');
      document.body.dispatchEvent(event('drop'));
      const pasted = new DataTransfer();
      pasted.items.add(new File(['x'], 'pasted.png', { type: 'image/png' }));
      document.body.dispatchEvent(new ClipboardEvent('paste', { bubbles: true, cancelable: true, clipboardData: pasted }));
    });
    await page.getByText('3 of 3 ready').waitFor();
    assert.deepEqual(names(bodies), ['dropped.png', 'pasted.png', 'second.png']);
    assert.ok(!(await page.locator('#drop').getAttribute('class')).includes('over'));
    await context.close();
  });

  test('uploads the pictures of a folder and its subfolders', async () => {
    const posts = [
      { status: 202, json: photo('a') },
      { status: 202, json: photo('b') },
    ];
    const { page, context, bodies } = await suite.open({ posts });
    await page.evaluate(() => {
      const file = (name, type) => ({ isFile: true, file: (done) => done(new File(['x'], name, { type })) });
      // like browsers, the reader returns a few entries at a time
      const folder = (...entries) => ({
        isDirectory: true,
        createReader: () => ({ readEntries: (done) => done(entries.splice(0, 2)) }),
      });
      const tree = folder(file('one.png', 'image/png'), file('notes.txt', 'text/plain'), folder(file('two.jpg', 'image/jpeg')));
      DataTransferItem.prototype.webkitGetAsEntry = () => tree;
      const files = new DataTransfer();
      files.items.add(new File([''], 'holiday'));
      document.body.dispatchEvent(new DragEvent('drop', { bubbles: true, cancelable: true, dataTransfer: files }));
    });
    await page.getByText('2 of 2 ready').waitFor();
    assert.deepEqual(names(bodies), ['one.png', 'two.jpg']);
    await context.close();
  });

  test('pairs a depth map with the photo in its folder', async () => {
    const posts = [
      { status: 202, json: photo('a') },
      { status: 202, json: photo('b') },
    ];
    const { page, context, bodies } = await suite.open({ posts });
    await page.evaluate(() => {
      const file = (name, content) => ({ isFile: true, file: (done) => done(new File([content], name, { type: 'image/png' })) });
      const folder = (...entries) => ({ isDirectory: true, createReader: () => ({ readEntries: (done) => done(entries.splice(0)) }) });
      const two = (content) => folder(file('photo.png', content), file('photo_depth.png', `${content} depth`));
      const tree = folder(two('here'), two('there'));
      DataTransferItem.prototype.webkitGetAsEntry = () => tree;
      const files = new DataTransfer();
      files.items.add(new File([''], 'holiday'));
      document.body.dispatchEvent(new DragEvent('drop', { bubbles: true, cancelable: true, dataTransfer: files }));
    });
    await page.getByText('2 of 2 ready').waitFor();
    const sent = bodies.map((body) => [...body.matchAll(/\r\n\r\n((?:there|here)[^\r]*)\r\n/g)].map(([, content]) => content)).sort();
    assert.deepEqual(sent, [
      ['here', 'here depth'],
      ['there', 'there depth'],
    ]);
    await context.close();
  });
});
