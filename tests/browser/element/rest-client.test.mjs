// The JavaScript client of the HTTP API: with the built program, and with failing servers.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { after, before, describe, test } from 'node:test';
import { Tmpi, TmpiError } from '../../../npm/rest-client.js';
import { boxDepth, boxPhoto } from '../support/pictures.mjs';
import { startServer } from '../support/program.mjs';

const PHOTO = new Uint8Array(readFileSync(new URL('../../../docs/sample.jpg', import.meta.url)));
const NONE = '0'.repeat(32);

/** Asserts that a promise rejects with a TmpiError of this reason and status. */
const assertRejects = (promise, reason, status) =>
  assert.rejects(promise, (error) => {
    assert.ok(error instanceof TmpiError, error.stack);
    assert.deepEqual([error.reason, error.status], [reason, status]);
    return true;
  });

describe('a client with the built program', () => {
  let server;
  let tmpi;
  let made;
  const seen = [];
  before(async () => {
    server = await startServer();
    tmpi = new Tmpi(server.url);
    const accepted = await tmpi.upload(PHOTO, { title: 'A "box" & more', options: { max_size: 320 } });
    assert.match(accepted.id, /^[0-9a-f]{32}$/);
    made = await tmpi.wait(accepted.id, { onEvent: (event) => seen.push(event) });
  });
  after(() => server?.close());

  test('uploads and reports progress', async () => {
    assert.equal(made.state, 'done');
    assert.equal(Math.max(made.width, made.height), 320);
    assert.deepEqual([seen.at(-1).type, seen.at(-1).data.id], ['done', made.id]);
    const again = await tmpi.upload(PHOTO, { options: { max_size: 320 }, wait: 5 });
    assert.deepEqual([again.id, again.settings.title], [made.id, 'A "box" & more']);
  });

  test('uploads a named file with a depth map', async () => {
    const file = new File([boxPhoto(200, 120)], 'a box.png');
    const { id, settings } = await tmpi.upload(file, { depth: new Uint8Array(boxDepth(200, 120)), wait: 20 });
    assert.equal(settings.title, 'a box');
    assert.equal((await tmpi.wait(id)).state, 'done');
    const ids = [];
    for await (const photo of tmpi.photos(1)) ids.push(photo.id);
    assert.deepEqual(ids, [id, made.id]);
    await tmpi.delete(id);
    await assertRejects(tmpi.state(id), 'refused', 404);
    await assertRejects(tmpi.wait(id), 'refused', 404);
  });

  test('fetches whole and partial containers, with ETags', async () => {
    const whole = await tmpi.atlas(made.id);
    assert.deepEqual([whole.mediaType, whole.bytes.length], ['application/vnd.tmpi', made.atlas_bytes]);
    assert.equal(new TextDecoder().decode(whole.bytes.subarray(0, 4)), 'TMPI');
    assert.equal(await tmpi.atlas(made.id, {}, whole.etag), null);
    const small = await tmpi.atlas(made.id, { level: 2 }, whole.etag);
    assert.ok(small.bytes.length < whole.bytes.length);
    const part = await tmpi.atlas(made.id, { sections: ['planes'], region: [0, 0, 64, 64] });
    assert.ok(part.bytes.length < small.bytes.length);
    await assertRejects(new Tmpi(server.url, { maxBytes: 1000 }).atlas(made.id), 'too-large');
  });

  test('fetches views, exports, depth, thumbnail and report', async () => {
    const view = await tmpi.view(made.id, { tx: 0.02, w: 64, format: 'png', crop: [0, 0, 0.5, 0.5] });
    assert.equal(view.mediaType, 'image/png');
    assert.equal(new DataView(view.bytes.buffer).getUint32(16), 64);
    const model = await tmpi.export(made.id, 'glb', 'metric');
    assert.equal(new TextDecoder().decode(model.bytes.subarray(0, 4)), 'glTF');
    assert.equal((await tmpi.depth(made.id)).mediaType, 'image/png');
    assert.equal((await tmpi.thumbnail(made.id)).mediaType, 'image/jpeg');
    assert.ok((await tmpi.report(made.id)).stages);
  });

  test('changes settings and strokes only if the ETag matches', async () => {
    const { etag } = await tmpi.state(made.id);
    const changed = await tmpi.change(made.id, { speed: 2 }, etag);
    assert.deepEqual([changed.value.settings.speed, changed.value.settings.title], [2, 'A "box" & more']);
    await assertRejects(tmpi.change(made.id, { speed: 3 }, etag), 'refused', 412);
    await assert.rejects(tmpi.change(made.id, { speed: 99 }), (error) => error.problem.field === 'speed');
    const strokes = [{ points: [[0.5, 0.5]], radius: 0.1, by: 0.2 }];
    await tmpi.touchUp(made.id, strokes, (await tmpi.strokes(made.id)).etag);
    assert.equal((await tmpi.wait(made.id)).state, 'done');
    assert.deepEqual((await tmpi.strokes(made.id)).value.strokes, strokes);
  });

  test('returns links and an iframe', async () => {
    await assertRejects(tmpi.link(made.id, 60), 'refused', 400);
    assert.equal((await tmpi.link(made.id)).page, `/view/${made.id}`);
    const frame = tmpi.embed(made);
    assert.equal(frame, `<iframe src="${server.url}/embed/${made.id}" title="A &quot;box&quot; &amp; more" allow="fullscreen"></iframe>`);
    assert.equal((await fetch(`${server.url}/embed/${made.id}`)).status, 200);
  });

  test('rejects with the reason', async () => {
    await assertRejects(tmpi.upload(new TextEncoder().encode('no picture')), 'refused', 415);
    await assertRejects(tmpi.report(NONE), 'refused', 404);
    await assertRejects(tmpi.state('../metrics'), 'input');
    assert.throws(() => tmpi.address('//elsewhere.example/'), { reason: 'answer' });
    assert.throws(() => new Tmpi(server.url, { ownerLink: `${server.url}/view/${NONE}` }), { reason: 'input' });
    const stop = AbortSignal.abort(new Error('enough'));
    await assert.rejects(tmpi.wait(made.id, { signal: stop }), { message: 'enough' });
  });
});

describe('a client with failing servers', () => {
  const servers = [];
  after(() => {
    for (const server of servers) {
      server.closeAllConnections();
      server.close();
    }
  });
  /** A server that responds with `respond(n, request, response)` to request n, from 0, and counts requests. */
  const startServerWith = async (respond) => {
    const mock = { count: 0, requests: [] };
    const server = createServer((request, response) => {
      mock.requests.push(request);
      respond(mock.count++, request, response);
    });
    servers.push(server);
    await new Promise((resume) => server.listen(0, '127.0.0.1', resume));
    mock.url = `http://127.0.0.1:${server.address().port}`;
    return mock;
  };
  const problem = (response, status, more = {}) => {
    response.writeHead(status, { 'content-type': 'application/problem+json', ...more });
    response.end(JSON.stringify({ type: 'urn:tmpi:problem:busy', title: 'Busy', status, detail: 'later' }));
  };
  const json = (response, value) => response.writeHead(200).end(JSON.stringify(value));

  test('reads are retried after failures, changes are not', async () => {
    const mock = await startServerWith((n, request, response) => {
      if (n === 0 || request.method === 'DELETE') problem(response, 503, { 'retry-after': '0' });
      else if (n === 1) response.destroy();
      else if (n === 3) json(response, { photos: [] });
    });
    const tmpi = new Tmpi(mock.url, { silence: 2000, longestPause: 100 });
    assert.deepEqual(await tmpi.list(), { photos: [] });
    assert.equal(mock.count, 4);
    await assertRejects(tmpi.delete(NONE), 'refused', 503);
    assert.equal(mock.count, 5);
  });

  test('retries everything after 429 unless the wait is long', async () => {
    const mock = await startServerWith((n, _, response) => {
      if (n === 0) problem(response, 429, { 'retry-after': '0' });
      else if (n === 1) response.writeHead(204).end();
      else problem(response, 429, { 'retry-after': '3600' });
    });
    const tmpi = new Tmpi(mock.url, { longestPause: 100 });
    await tmpi.delete(NONE);
    assert.equal(mock.count, 2);
    await assert.rejects(tmpi.list(), (error) => error.problem.retry_after === 3600);
    assert.equal(mock.count, 3);
  });

  test('only uploads of an owner are retried', async () => {
    const mock = await startServerWith((_, request, response) => {
      request.resume();
      request.on('end', () => problem(response, 503));
    });
    const options = { longestPause: 10, tries: 3 };
    await assertRejects(new Tmpi(mock.url, options).upload(PHOTO), 'refused', 503);
    assert.equal(mock.count, 1);
    const owner = new Tmpi(mock.url, { ...options, ownerLink: `${mock.url}/view/${NONE}#owner=tmpi_o_${'a'.repeat(40)}` });
    await assertRejects(owner.upload(PHOTO), 'refused', 503);
    assert.equal(mock.count, 4);
    assert.equal(mock.requests.at(-1).headers.authorization, `Bearer tmpi_o_${'a'.repeat(40)}`);
  });

  test('a manage link authorises requests and can be revoked', async () => {
    const mock = await startServerWith((_, __, response) => response.writeHead(204).end());
    const token = `tmpi_m_${'0f'.repeat(32)}`;
    await new Tmpi(mock.url, { manageLink: `${mock.url}/view/${NONE}#manage=${token}` }).takeLinksBack(NONE);
    const { method, url, headers } = mock.requests[0];
    assert.deepEqual([method, url, headers.authorization], ['DELETE', `/v1/photos/${NONE}/manage`, `Bearer ${token}`]);
    for (const wrong of [`/view/${NONE}`, `/view/${NONE}#manage=tmpi_o_${'a'.repeat(64)}`, `#manage=${token}0`])
      assert.throws(() => new Tmpi(mock.url, { manageLink: wrong }), { reason: 'input' });
    const state = { links: { embed: `/embed/${NONE}` }, settings: {} };
    const frame = new Tmpi(mock.url).embed(state, { query: 'expires=1&signature=5e' });
    assert.ok(frame.includes(`src="${mock.url}/embed/${NONE}?expires=1&amp;signature=5e"`), frame);
  });

  test('polls the state after an interrupted event stream', async () => {
    const mock = await startServerWith((n, request, response) => {
      if (request.url.endsWith('/events')) {
        response.writeHead(200, { 'content-type': 'text/event-stream' });
        response.write(': hello\n\nevent: queued\nda');
        response.end(n === 0 ? 'ta: {"position": 4}\n\nevent: st' : '');
      } else json(response, { id: NONE, state: n === 1 ? 'queued' : 'done' });
    });
    const seen = [];
    const made = await new Tmpi(mock.url, { longestPause: 50 }).wait(NONE, { onEvent: (event) => seen.push(event) });
    assert.deepEqual([made.state, mock.count, seen], ['done', 4, [{ type: 'queued', data: { position: 4 } }]]);
  });

  test('reports photos that time out or fail', async () => {
    const mock = await startServerWith((_, request, response) => {
      if (!request.url.endsWith('/events')) json(response, { id: NONE, state: 'working' });
      else response.writeHead(200).end();
    });
    await assertRejects(new Tmpi(mock.url, { longestPause: 20 }).wait(NONE, { limit: 300 }), 'late');
    const failed = await startServerWith((_, _request, response) => {
      response.writeHead(200).end('event: failed\ndata: {"title": "Broken", "status": 422, "detail": "no pixels"}\n\n');
    });
    await assertRejects(new Tmpi(failed.url).wait(NONE), 'not-made', 422);
  });

  test('rejects invalid, foreign and redirected responses', async () => {
    const mock = await startServerWith((n, _, response) => {
      if (n === 0) response.writeHead(200).end('<html>');
      else if (n === 1) response.writeHead(404).end('nothing here');
      else response.writeHead(302, { location: 'http://127.0.0.1:9/' }).end();
    });
    const tmpi = new Tmpi(mock.url, { tries: 1 });
    await assertRejects(tmpi.list(), 'answer');
    await assert.rejects(tmpi.list(), (error) => error.status === 404 && error.problem.detail === 'nothing here');
    await assertRejects(tmpi.list(), 'connection');
  });
});
