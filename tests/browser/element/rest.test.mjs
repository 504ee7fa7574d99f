// The client of the HTTP interface: against the built program, and against servers that fail in a way of their own.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import net from 'node:net';
import { after, before, describe, test } from 'node:test';
import { Tmpi, TmpiError } from '../../../npm/rest.js';
import { boxDepth, boxPhoto } from '../support/pictures.mjs';
import { startServer } from '../support/program.mjs';

const PHOTO = new Uint8Array(readFileSync(new URL('../../../docs/sample.jpg', import.meta.url)));
const NONE = '0'.repeat(32);

/** Rejects as a TmpiError of this reason, with this status. */
const refuses = (promise, reason, status) =>
  assert.rejects(promise, (error) => {
    assert.ok(error instanceof TmpiError, error.stack);
    assert.deepEqual([error.reason, error.status], [reason, status]);
    return true;
  });

describe('a client of the built program', () => {
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

  test('uploads, and is told what happens until the photo is made', async () => {
    assert.equal(made.state, 'done');
    assert.equal(Math.max(made.width, made.height), 320);
    assert.deepEqual([seen.at(-1).type, seen.at(-1).data.id], ['done', made.id]);
    const again = await tmpi.upload(PHOTO, { options: { max_size: 320 }, wait: 5 });
    assert.deepEqual([again.id, again.settings.title], [made.id, 'A "box" & more']);
  });

  test('takes a file by its name, with a depth map', async () => {
    const file = new File([boxPhoto(200, 120)], 'a box.png');
    const { id, settings } = await tmpi.upload(file, { depth: new Uint8Array(boxDepth(200, 120)), wait: 20 });
    assert.equal(settings.title, 'a box');
    assert.equal((await tmpi.wait(id)).state, 'done');
    const ids = [];
    for await (const photo of tmpi.photos(1)) ids.push(photo.id);
    assert.deepEqual(ids, [id, made.id]);
    await tmpi.delete(id);
    await refuses(tmpi.state(id), 'refused', 404);
    await refuses(tmpi.wait(id), 'refused', 404);
  });

  test('fetches containers, whole, in part, and only what it has not', async () => {
    const whole = await tmpi.atlas(made.id);
    assert.deepEqual([whole.mediaType, whole.bytes.length], ['application/vnd.tmpi', made.atlas_bytes]);
    assert.equal(new TextDecoder().decode(whole.bytes.subarray(0, 4)), 'TMPI');
    assert.equal(await tmpi.atlas(made.id, {}, whole.etag), null);
    const small = await tmpi.atlas(made.id, { level: 2 }, whole.etag);
    assert.ok(small.bytes.length < whole.bytes.length);
    const part = await tmpi.atlas(made.id, { sections: ['planes'], region: [0, 0, 64, 64] });
    assert.ok(part.bytes.length < small.bytes.length);
    await refuses(new Tmpi(server.url, { maxBytes: 1000 }).atlas(made.id), 'too-large');
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

  test('changes settings and strokes, only if they are those that were seen', async () => {
    const { etag } = await tmpi.state(made.id);
    const changed = await tmpi.change(made.id, { speed: 2 }, etag);
    assert.deepEqual([changed.value.settings.speed, changed.value.settings.title], [2, 'A "box" & more']);
    await refuses(tmpi.change(made.id, { speed: 3 }, etag), 'refused', 412);
    await assert.rejects(tmpi.change(made.id, { speed: 99 }), (error) => error.problem.field === 'speed');
    const strokes = [{ points: [[0.5, 0.5]], radius: 0.1, by: 0.2 }];
    await tmpi.touchUp(made.id, strokes, (await tmpi.strokes(made.id)).etag);
    assert.equal((await tmpi.wait(made.id)).state, 'done');
    assert.deepEqual((await tmpi.strokes(made.id)).value.strokes, strokes);
  });

  test('gives links and a frame to embed', async () => {
    await refuses(tmpi.link(made.id, 60), 'refused', 400);
    assert.equal((await tmpi.link(made.id)).page, `/view/${made.id}`);
    const frame = tmpi.embed(made);
    assert.equal(frame, `<iframe src="${server.url}/embed/${made.id}" title="A &quot;box&quot; &amp; more" allow="fullscreen"></iframe>`);
    assert.equal((await fetch(`${server.url}/embed/${made.id}`)).status, 200);
  });

  test('says what is wrong', async () => {
    await refuses(tmpi.upload(new TextEncoder().encode('no picture')), 'refused', 415);
    await refuses(tmpi.report(NONE), 'refused', 404);
    await refuses(tmpi.state('../metrics'), 'input');
    assert.throws(() => tmpi.address('//elsewhere.example/'), { reason: 'answer' });
    assert.throws(() => new Tmpi(server.url, { ownerLink: `${server.url}/view/${NONE}` }), { reason: 'input' });
    const stop = AbortSignal.abort(new Error('enough'));
    await assert.rejects(tmpi.wait(made.id, { signal: stop }), { message: 'enough' });
  });
});

describe('a large upload to the built program', () => {
  const BYTES = 18 * 2 ** 20;
  /** A photo of some megabytes: what is behind a PNG is no part of the picture. */
  const large = new Uint8Array(Buffer.concat([boxPhoto(60, 40), Buffer.alloc(BYTES)]));
  let server;
  before(async () => {
    server = await startServer();
  });
  after(() => server?.close());

  /**
   * What lies between client and program, and cuts a connection after so many bytes of the client's in all, once for each of `cuts`;
   * `deaf` has it cut the connection once more in place of the answer that a photo was accepted.
   */
  const wire = async ({ cuts = [], deaf = false }) => {
    const told = { sent: 0, cut: 0 };
    const { hostname, port } = new URL(server.url);
    const between = net.createServer((client) => {
      const program = net.connect(Number(port), hostname);
      const end = () => {
        client.destroy();
        program.destroy();
      };
      client.on('data', (bytes) => {
        told.sent += bytes.length;
        program.write(bytes);
        if (!(told.sent >= cuts[told.cut])) return;
        told.cut++;
        // what was written arrives
        client.destroy();
        program.end();
      });
      program.on('data', (bytes) => {
        if (deaf && bytes.toString('latin1').startsWith('HTTP/1.1 202')) {
          deaf = false;
          told.cut++;
          end();
        } else client.write(bytes);
      });
      for (const socket of [client, program]) socket.on('error', end);
      client.on('close', () => program.end());
      program.on('close', end);
    });
    await new Promise((resume) => between.listen(0, '127.0.0.1', resume));
    told.url = `http://127.0.0.1:${between.address().port}`;
    told.close = () => between.close();
    return told;
  };

  test('goes on after cuts, and does not send twice what is there', async () => {
    const told = await wire({ cuts: [5 * 2 ** 20, 12 * 2 ** 20] });
    const seen = [];
    const tmpi = new Tmpi(told.url, { longestPause: 50 });
    const { id } = await tmpi.upload(large, { title: 'Large', onProgress: (sent, all) => seen.push([sent, all]) });
    const made = await tmpi.wait(id);
    assert.deepEqual([made.state, made.photo_bytes, made.settings.title, told.cut], ['done', large.length, 'Large', 2]);
    assert.ok(told.sent < 1.5 * large.length, `${told.sent} bytes of ${large.length} were sent`);
    assert.deepEqual([seen[0], seen.at(-1)], [[0, large.length], Array(2).fill(large.length)]);
    const offsets = seen.slice(0, -1).map(([sent]) => sent);
    assert.ok(
      offsets.every((sent, i) => !i || sent >= offsets[i - 1]),
      `${offsets}`,
    );
    // of a part that was cut something is there
    assert.ok(
      offsets.some((sent) => sent % (8 * 2 ** 20)),
      `${offsets}`,
    );
    await tmpi.delete(id);
    told.close();
  });

  test('of which the answer alone was lost is found', async () => {
    const told = await wire({ deaf: true });
    const tmpi = new Tmpi(told.url, { longestPause: 50 });
    const file = new File([large], 'a box.png');
    const { id, settings } = await tmpi.upload(file);
    assert.deepEqual([settings.title, told.cut], ['a box', 1]);
    assert.equal((await tmpi.wait(id)).photo_bytes, large.length);
    await tmpi.delete(id);
    told.close();
  });

  test('that is no picture is refused, and one that is stopped gives its place back', async () => {
    const tmpi = new Tmpi(server.url);
    await refuses(tmpi.upload(new Uint8Array(BYTES)), 'refused', 415);
    const stop = new AbortController();
    const onProgress = (sent) => sent && stop.abort(new Error('enough'));
    await assert.rejects(tmpi.upload(large, { signal: stop.signal, onProgress }), { message: 'enough' });
    const left = async () => {
      const metrics = await (await fetch(`${server.url}/metrics`)).text();
      return Number(/^tmpi_partial_uploads (\S+)$/m.exec(metrics)[1]);
    };
    while (await left()) await new Promise((resume) => setTimeout(resume, 50));
    assert.deepEqual((await tmpi.list()).photos, []);
  });

  test('goes at once where the server takes no parts', async () => {
    const whole = await startServer(['--partial-uploads', '0']);
    try {
      const { id } = await new Tmpi(whole.url).upload(large, { title: 'At once' });
      assert.deepEqual((await new Tmpi(whole.url).wait(id)).settings.title, 'At once');
    } finally {
      await whole.close();
    }
  });
});

describe('a client of servers that fail', () => {
  const servers = [];
  after(() => {
    for (const server of servers) {
      server.closeAllConnections();
      server.close();
    }
  });
  /** A server that answers request number n, from 0, by `answer(n, request, response)`; counts them. */
  const failing = async (answer) => {
    const told = { count: 0, requests: [] };
    const server = createServer((request, response) => {
      told.requests.push(request);
      answer(told.count++, request, response);
    });
    servers.push(server);
    await new Promise((resume) => server.listen(0, '127.0.0.1', resume));
    told.url = `http://127.0.0.1:${server.address().port}`;
    return told;
  };
  const problem = (response, status, more = {}) => {
    response.writeHead(status, { 'content-type': 'application/problem+json', ...more });
    response.end(JSON.stringify({ type: 'urn:tmpi:problem:busy', title: 'Busy', status, detail: 'later' }));
  };
  const json = (response, value) => response.writeHead(200).end(JSON.stringify(value));

  test('what reads is tried again after 503, a broken connection and silence; what changes is not', async () => {
    const told = await failing((n, request, response) => {
      if (n === 0 || request.method === 'DELETE') problem(response, 503, { 'retry-after': '0' });
      else if (n === 1) response.destroy();
      else if (n === 3) json(response, { photos: [] });
    });
    const tmpi = new Tmpi(told.url, { silence: 2000, longestPause: 100 });
    assert.deepEqual(await tmpi.list(), { photos: [] });
    assert.equal(told.count, 4);
    await refuses(tmpi.delete(NONE), 'refused', 503);
    assert.equal(told.count, 5);
  });

  test('after 429 everything is tried again, unless it takes too long', async () => {
    const told = await failing((n, _, response) => {
      if (n === 0) problem(response, 429, { 'retry-after': '0' });
      else if (n === 1) response.writeHead(204).end();
      else problem(response, 429, { 'retry-after': '3600' });
    });
    const tmpi = new Tmpi(told.url, { longestPause: 100 });
    await tmpi.delete(NONE);
    assert.equal(told.count, 2);
    await assert.rejects(tmpi.list(), (error) => error.problem.retry_after === 3600);
    assert.equal(told.count, 3);
  });

  test('uploads of nobody are not sent twice, those of an owner are', async () => {
    const told = await failing((_, request, response) => {
      request.resume();
      request.on('end', () => problem(response, 503));
    });
    const options = { longestPause: 10, tries: 3 };
    await refuses(new Tmpi(told.url, options).upload(PHOTO), 'refused', 503);
    assert.equal(told.count, 1);
    const owner = new Tmpi(told.url, { ...options, ownerLink: `${told.url}/view/${NONE}#owner=tmpi_o_${'a'.repeat(40)}` });
    await refuses(owner.upload(PHOTO), 'refused', 503);
    assert.equal(told.count, 4);
    assert.equal(told.requests.at(-1).headers.authorization, `Bearer tmpi_o_${'a'.repeat(40)}`);
  });

  test('a link to change a photo says who asks, and is taken back', async () => {
    const told = await failing((_, __, response) => response.writeHead(204).end());
    const token = `tmpi_m_${'0f'.repeat(32)}`;
    await new Tmpi(told.url, { manageLink: `${told.url}/view/${NONE}#manage=${token}` }).takeLinksBack(NONE);
    const { method, url, headers } = told.requests[0];
    assert.deepEqual([method, url, headers.authorization], ['DELETE', `/v1/photos/${NONE}/manage`, `Bearer ${token}`]);
    for (const wrong of [`/view/${NONE}`, `/view/${NONE}#manage=tmpi_o_${'a'.repeat(64)}`, `#manage=${token}0`])
      assert.throws(() => new Tmpi(told.url, { manageLink: wrong }), { reason: 'input' });
    const state = { links: { embed: `/embed/${NONE}` }, settings: {} };
    const frame = new Tmpi(told.url).embed(state, { query: 'expires=1&signature=5e' });
    assert.ok(frame.includes(`src="${told.url}/embed/${NONE}?expires=1&amp;signature=5e"`), frame);
  });

  test('parts that nobody takes are given up, and so is the upload', async () => {
    const told = await failing((n, request, response) => {
      request.resume();
      request.on('end', () => {
        if (n === 0) response.writeHead(201, { location: '/v1/uploads/u1' }).end();
        else if (request.method === 'GET') json(response, { offset: 0, complete: false });
        else if (request.method === 'DELETE') response.writeHead(204).end();
        else problem(response, 503);
      });
    });
    await refuses(new Tmpi(told.url, { longestPause: 10, tries: 3 }).upload(PHOTO, { parts: true }), 'refused', 503);
    while (told.count < 7) await new Promise((resume) => setTimeout(resume, 10));
    const asked = told.requests.map(({ method, url }) => `${method} ${url}`);
    const [part, look] = ['PATCH /v1/uploads/u1', 'GET /v1/uploads/u1'];
    assert.deepEqual(asked, ['POST /v1/photos', part, look, part, look, part, 'DELETE /v1/uploads/u1']);
    const { 'upload-offset': at, 'upload-complete': last } = told.requests[1].headers;
    assert.deepEqual([at, last, told.requests[0].headers['upload-length']], ['0', '?1', String(PHOTO.length)]);
  });

  test('a stream of events that breaks off is followed by a look at the state', async () => {
    const told = await failing((n, request, response) => {
      if (request.url.endsWith('/events')) {
        response.writeHead(200, { 'content-type': 'text/event-stream' });
        response.write(': hello\n\nevent: queued\nda');
        response.end(n === 0 ? 'ta: {"position": 4}\n\nevent: st' : '');
      } else json(response, { id: NONE, state: n === 1 ? 'queued' : 'done' });
    });
    const seen = [];
    const made = await new Tmpi(told.url, { longestPause: 50 }).wait(NONE, { onEvent: (event) => seen.push(event) });
    assert.deepEqual([made.state, told.count, seen], ['done', 4, [{ type: 'queued', data: { position: 4 } }]]);
  });

  test('a photo that is never made is late, and one that fails says why', async () => {
    const told = await failing((_, request, response) => {
      if (!request.url.endsWith('/events')) json(response, { id: NONE, state: 'working' });
      else response.writeHead(200).end();
    });
    await refuses(new Tmpi(told.url, { longestPause: 20 }).wait(NONE, { limit: 300 }), 'late');
    const failed = await failing((_, _request, response) => {
      response.writeHead(200).end('event: failed\ndata: {"title": "Broken", "status": 422, "detail": "no pixels"}\n\n');
    });
    await refuses(new Tmpi(failed.url).wait(NONE), 'not-made', 422);
  });

  test('answers without end, of others, or elsewhere are no answers', async () => {
    const told = await failing((n, _, response) => {
      if (n === 0) response.writeHead(200).end('<html>');
      else if (n === 1) response.writeHead(404).end('nothing here');
      else response.writeHead(302, { location: 'http://127.0.0.1:9/' }).end();
    });
    const tmpi = new Tmpi(told.url, { tries: 1 });
    await refuses(tmpi.list(), 'answer');
    await assert.rejects(tmpi.list(), (error) => error.status === 404 && error.problem.detail === 'nothing here');
    await refuses(tmpi.list(), 'connection');
  });
});
