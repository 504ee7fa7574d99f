// The npm package, on a server with only its files and a container.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, statSync, writeFileSync } from 'node:fs';
import { createServer, request as httpRequest } from 'node:http';
import { createRequire } from 'node:module';
import { tmpdir } from 'node:os';
import { dirname, extname, join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { pack } from '../../../npm/pack.mjs';
import { launch, openPage, seriousViolations } from '../support/browser.mjs';
import { boxContainer } from '../support/container.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { startServer } from '../support/program.mjs';

const TYPES = { '.js': 'text/javascript', '.wasm': 'application/wasm', '.wgsl': 'text/plain', '.html': 'text/html' };
const POLICY =
  "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'; worker-src 'self' blob:; img-src 'self' blob:";
const PAGE = `<!doctype html><title>package</title><script type="module" src="/tmpi-viewer/tmpi-viewer.js"></script>
  <tmpi-viewer src="/photo.tmpi" alt="A box"></tmpi-viewer>`;
/** Valid and invalid uses of the types. */
const USE = `import 'tmpi-viewer';
  const viewer = document.querySelector('tmpi-viewer')!;
  viewer.addEventListener('load', ({ detail }) => detail.mode === 'webgl');
  const file: Promise<Blob> = viewer.toBlob();
  viewer.addEventListener('state', ({ detail }) => detail.state === 'waiting');
  viewer.addEventListener('statistics', ({ detail }) => detail.behind + detail.frames);
  const soundOn: Promise<void> = viewer.setSound(true);
  // @ts-expect-error no such state
  viewer.addEventListener('state', ({ detail }) => detail.state === 'asleep');
  // @ts-expect-error no such mode
  viewer.addEventListener('load', ({ detail }) => detail.mode === 'vulkan');
  viewer.src = '/photo.tmpi';
  viewer.speed = 2;
  viewer.room = null;
  // @ts-expect-error not a URL
  viewer.poster = new Blob();
  // @ts-expect-error read-only
  viewer.loaded = true;
  import { Tmpi } from 'tmpi-viewer/rest-client';
  const tmpi = new Tmpi('https://photos.example');
  const made = tmpi.wait('id', { onEvent: (event) => event.type === 'stage' && event.data.step });
  const atlas: Promise<Uint8Array> = tmpi.atlas('id', { sections: ['photo'] }).then(({ bytes }) => bytes);
  // @ts-expect-error null for an unchanged tag
  tmpi.atlas('id', {}, 'tag').then(({ bytes }) => bytes);
  // @ts-expect-error no such setting
  tmpi.change('id', { tilte: 'A box' });
  export { file, soundOn, made, atlas };`;

describe('npm package', () => {
  const folder = mkdtempSync(join(tmpdir(), 'tmpi-npm-'));
  const root = join(folder, 'node_modules/tmpi-viewer');
  let archive;
  let server;
  let missing;
  before(async () => {
    archive = pack(join(folder, 'packed'));
    execFileSync('mkdir', ['-p', root]);
    execFileSync('tar', ['-xzf', archive, '-C', root, '--strip-components=1']);
    missing = [];
    server = createServer((request, response) => {
      const reply = (type, body) => {
        response.writeHead(200, { 'content-type': type, 'content-security-policy': POLICY });
        response.end(body);
      };
      if (request.url === '/') return reply('text/html', PAGE);
      if (request.url === '/photo.tmpi') return reply('application/octet-stream', boxContainer());
      try {
        if (!request.url.startsWith('/tmpi-viewer/')) throw new Error('not in the package');
        reply(
          TYPES[extname(request.url)] ?? 'application/octet-stream',
          readFileSync(join(root, request.url.slice('/tmpi-viewer/'.length))),
        );
      } catch {
        missing.push(request.url);
        response.writeHead(404).end();
      }
    });
    await new Promise((resume) => server.listen(0, '127.0.0.1', resume));
  });
  after(() => {
    server.closeAllConnections();
    server.close();
    rmSync(folder, { recursive: true, force: true });
  });

  test('contains only the necessary files', () => {
    const files = execFileSync('tar', ['-tzf', archive], { encoding: 'utf8' }).trim().split('\n');
    for (const name of [
      'README.md',
      'LICENSE-MIT',
      'LICENSE-APACHE',
      'tmpi-viewer.js',
      'tmpi-viewer.d.ts',
      'rest-client.js',
      'rest-client.d.ts',
      'upload.html',
      'static/decode/decoder.wasm',
      'static/element/room.js',
      'static/i18n/messages.js',
      'static/live/decoder.wasm',
      'static/live/worker.js',
    ])
      assert.ok(files.includes(`package/${name}`), name);
    assert.deepEqual(
      files.filter((name) => /\/(?:app|film|vendor|sample)\/|\/(?:publisher|encoders|frames|microphone.*)\.js$/.test(name)),
      [],
    );
    const { version } = JSON.parse(readFileSync(join(root, 'package.json'), 'utf8'));
    assert.match(version, /^[1-9]\d*\.|^0\.[1-9]/);
    assert.ok(statSync(archive).size < 600_000, `${statSync(archive).size} bytes`);
  });

  for (const [mode, webgpu] of [
    ['gpu', true],
    ['webgl', false],
  ]) {
    test(`shows and moves a photo under a strict policy (${mode})`, async () => {
      const browser = await launch({ webgpu: true });
      const { page, errors } = await openPage(browser);
      if (!webgpu) await page.addInitScript(() => Object.defineProperty(navigator, 'gpu', { value: undefined }));
      await page.goto(`http://127.0.0.1:${server.address().port}/`);
      await page.waitForFunction((wanted) => document.querySelector('tmpi-viewer').viewer?.mode === wanted, mode);
      await page.locator('tmpi-viewer .stage').focus();
      await page.keyboard.press('ArrowRight');
      await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer.pose.tx > 0.002);
      const bytes = await page.evaluate(async () => (await document.querySelector('tmpi-viewer').toBlob()).size);
      assert.ok(bytes > 1000, `${bytes}`);
      assert.deepEqual(
        missing.filter((name) => name !== '/favicon.ico'),
        [],
      );
      assert.deepEqual(
        errors.filter((e) => !/favicon/.test(e)),
        [],
      );
      await browser.close();
    });
  }

  test('the example page uploads and shows photos', async () => {
    const program = await startServer();
    // one origin: the package's folder, and a proxy to the program
    const site = createServer((request, response) => {
      const { pathname } = new URL(request.url, 'http://localhost');
      if (pathname.startsWith('/tmpi-viewer/')) {
        response.writeHead(200, { 'content-type': TYPES[extname(pathname)] ?? 'application/octet-stream' });
        return response.end(readFileSync(join(root, pathname.slice('/tmpi-viewer/'.length))));
      }
      const { method, headers } = request;
      const proxied = httpRequest(new URL(request.url, program.url), { method, headers }, (upstream) => {
        response.writeHead(upstream.statusCode, upstream.headers);
        upstream.pipe(response);
      });
      proxied.on('error', () => response.destroy());
      response.on('close', () => proxied.destroy());
      return request.pipe(proxied);
    });
    await new Promise((resume) => site.listen(0, '127.0.0.1', resume));
    const url = `http://127.0.0.1:${site.address().port}`;
    const browser = await launch({ webgpu: true });
    try {
      const { page, errors } = await openPage(browser);
      await page.goto(`${url}/tmpi-viewer/upload.html`);
      for (const [name, length] of [
        ['a box.png', 0],
        ['a large box.png', 5 * 2 ** 20],
      ]) {
        const buffer = Buffer.concat([boxPhoto(200, 120 + length / 2 ** 20), Buffer.alloc(length)]);
        await page.locator('input[type=file]').setInputFiles([{ name, mimeType: 'image/png', buffer }]);
        await page.getByRole('button', { name: 'Upload' }).click();
        const viewer = page.locator(`tmpi-viewer[alt="${name.replace('.png', '')}"]`);
        await viewer.waitFor();
        await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode);
        const src = await viewer.getAttribute('src');
        const id = /photos\/([0-9a-f]{32})\/atlas/.exec(src)?.[1];
        assert.ok(src.startsWith(url) && id, src);
        assert.match(
          await page.locator('#snippet').inputValue(),
          new RegExp(`^<iframe src="${url}/embed/${id}" title="${name.replace('.png', '')}"`),
        );
        const words = await page.locator('[role=status]').textContent();
        assert.match(words, /done|shown/i);
      }
      await page.locator('input[type=file]').setInputFiles([{ name: 'none.png', mimeType: 'image/png', buffer: Buffer.from('none') }]);
      await page.getByRole('button', { name: 'Upload' }).click();
      await page.getByRole('status').filter({ hasText: '415' }).waitFor();
      assert.deepEqual(await seriousViolations(page), []);
      assert.deepEqual(
        errors.filter((e) => !/favicon|415/.test(e)),
        [],
      );
    } finally {
      await browser.close();
      site.closeAllConnections();
      site.close();
      await program.close();
    }
  });

  test('types accept valid and reject invalid uses', () => {
    writeFileSync(join(folder, 'use.ts'), USE);
    const tsc = join(dirname(createRequire(import.meta.url).resolve('typescript/package.json')), 'bin/tsc');
    const words = ['--noEmit', '--strict', '--module', 'esnext', '--moduleResolution', 'bundler', '--target', 'esnext', 'use.ts'];
    try {
      execFileSync(process.execPath, [tsc, ...words], { cwd: folder, encoding: 'utf8' });
    } catch (error) {
      assert.fail(error.stdout);
    }
  });
});
