// A fake server for tests of the viewer: serves static/ like the real one, and one photo with a given container.
import { readFile } from 'node:fs/promises';
import { createServer } from 'node:http';
import { extname, normalize } from 'node:path';
import { boxDepth, boxPhoto } from './pictures.mjs';

const STATIC = new URL('../../../static/', import.meta.url);
const TYPES = {
  '.js': 'text/javascript',
  '.mjs': 'text/javascript',
  '.css': 'text/css',
  '.html': 'text/html; charset=utf-8',
  '.svg': 'image/svg+xml',
  '.wasm': 'application/wasm',
  '.wgsl': 'text/wgsl',
  '.tmpi': 'application/vnd.tmpi',
  '.json': 'application/json',
  '.png': 'image/png',
};
/** Files that the server serves at other paths. */
const PAGES = { '/': 'app/upload-page.html', '/tmpi-viewer.js': 'element/tmpi-viewer.js' };
const POLICY =
  "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; img-src 'self' blob: data:; media-src 'self' blob:; object-src 'none'; base-uri 'none'; frame-ancestors 'self'";

/** Views by size; each is made once. */
const viewFiles = new Map();
function viewOf(width, height) {
  const size = `${width} ${height}`;
  if (!viewFiles.has(size)) viewFiles.set(size, boxPhoto(width, height));
  return viewFiles.get(size);
}

/** How the box was made; its last tile has an error of 1 pixel. */
const REPORT = { depth_model: 'given', stages: [], input: {}, error: { tile_px: [0, 0, 0, 0, 0, 0, 0, 1] } };

/**
 * @param {{atlas: Buffer, wasm?: boolean}} photo `wasm`: whether the page's content security policy allows WebAssembly
 * @returns {Promise<{url: string, views: string[], deleted: string[], held: {atlas?: Promise<void>, view?: Promise<void>}, close: () => Promise<void>}>}
 *   `held`: promises that delay a view, and the rest of a container after its photo
 */
export async function serve({ atlas, wasm = true }) {
  const views = [];
  const deleted = [];
  const patches = [];
  const posts = [];
  const state = { id: 'box', state: 'done' };
  const held = {};
  const server = createServer(async (request, response) => {
    const url = new URL(request.url, 'http://localhost');
    const send = (status, type, body) => {
      const headers = { 'content-type': type, 'content-length': Buffer.byteLength(body), 'access-control-allow-origin': '*' };
      const policy = url.searchParams.get('policy');
      if (policy) headers['content-security-policy'] = policy;
      else if (!url.pathname.startsWith('/embed'))
        headers['content-security-policy'] = wasm ? POLICY : POLICY.replace(" 'wasm-unsafe-eval'", '');
      response.writeHead(status, headers);
      response.end(body);
    };
    if (request.method === 'DELETE') {
      deleted.push(url.pathname);
      return send(200, 'text/plain', '');
    }
    if (request.method === 'POST' && /^\/v1\/(owner|photos\/box\/manage)$/.test(url.pathname)) {
      posts.push([url.pathname + url.search, request.headers.authorization]);
      response.writeHead(url.pathname === '/v1/owner' && !url.search && state.another ? 409 : 204);
      return response.end();
    }
    if (url.pathname === '/v1/owner/ticket')
      return send(state.ticket ? 200 : 403, 'application/json', JSON.stringify({ ticket: state.ticket, expires: 1 }));
    if (url.pathname === '/v1/presets') return send(200, 'application/json', JSON.stringify(state.presets ?? { presets: [], only: false }));
    if (url.pathname === '/v1/photos/box') {
      if (request.method === 'PATCH') {
        let body = '';
        for await (const part of request) body += part;
        patches.push({ headers: request.headers, body });
        state.settings = Object.fromEntries(Object.entries({ ...state.settings, ...JSON.parse(body) }).filter(([, v]) => v !== null));
        if (state.visibility) state.visibility = state.settings.visibility ?? 'private';
      }
      response.setHeader('etag', `"${patches.length + 1}"`);
      return send(200, 'application/json', JSON.stringify(state));
    }
    if (url.pathname === '/v1/photos/box/links' && state.links) {
      const seconds = Number(url.searchParams.get('seconds'));
      const page = `/view/box?expires=${seconds}&signature=5e`;
      return send(200, 'application/json', JSON.stringify({ page, expires: Math.floor(Date.now() / 1000) + seconds, ...state.links }));
    }
    if (url.pathname === '/v1/photos/box/settings') return send(200, 'application/json', JSON.stringify(state.settings ?? {}));
    if (url.pathname === '/v1/photos/box/strokes') return send(200, 'application/json', JSON.stringify({ version: 1, strokes: [] }));
    if (url.pathname === '/v1/photos/box/depth') return send(200, 'image/png', boxDepth(200, 120));
    if (url.pathname === '/v1/photos/box/report') return send(200, 'application/json', JSON.stringify(REPORT));
    if (url.pathname === '/v1/photos/box/atlas') return sendAtlas(response, atlas, held);
    if (url.pathname === '/embed/blank')
      return send(200, TYPES['.html'], '<!doctype html><title>blank</title><link rel="icon" href="data:,">');
    if (url.pathname === '/embed/three') return send(200, TYPES['.html'], threeElementsPage());
    if (url.pathname === '/embed')
      return send(
        200,
        TYPES['.html'],
        embeddingPage(url.searchParams.get('host'), url.searchParams.get('more') ?? 'still', url.searchParams.get('in')),
      );
    if (url.pathname === '/v1/photos/box/view') {
      views.push(url.search);
      await held.view;
      return send(200, 'image/png', viewOf(Number(url.searchParams.get('w')), Number(url.searchParams.get('h'))));
    }
    const name =
      PAGES[url.pathname] ?? (url.pathname.startsWith('/view/') ? 'app/view-page.html' : url.pathname.replace(/^\/static\//, ''));
    try {
      send(200, TYPES[extname(name)] ?? 'application/octet-stream', await readFile(new URL(normalize(name).replace(/^[/.]+/, ''), STATIC)));
    } catch {
      const problem = { type: 'about:blank', title: 'Not Found', status: 404, detail: `there is no ${url.pathname}` };
      send(404, 'application/problem+json', JSON.stringify(problem));
    }
  });
  await new Promise((resume) => server.listen(0, '127.0.0.1', resume));
  return {
    url: `http://127.0.0.1:${server.address().port}`,
    views,
    deleted,
    patches,
    posts,
    state,
    held,
    close: () => {
      server.closeAllConnections();
      return new Promise((resume) => server.close(resume));
    },
  };
}

/** Sends the container in two parts; the second starts after the photo. */
async function sendAtlas(response, atlas, held) {
  const headers = { 'content-type': 'application/vnd.tmpi', 'content-length': atlas.length, 'access-control-allow-origin': '*' };
  response.writeHead(200, headers);
  const split = Math.floor(atlas.length * 0.9);
  response.write(atlas.subarray(0, split));
  await held.atlas;
  response.end(atlas.subarray(split));
}

/** A page with three elements, the last far below. */
function threeElementsPage() {
  const element = (more) => `<tmpi-viewer src="/v1/photos/box/atlas" alt="A box" ${more}></tmpi-viewer>`;
  return `<!doctype html><title>three</title><script type="module" src="/tmpi-viewer.js"></script><style>tmpi-viewer { width: 300px }</style>
    ${element('auto-rotate="off"')}${element('camera-controls="off"')}<div style="height: 4000px"></div>${element('still')}`;
}

/** A page of another site with the element; `more`: further attributes, `within`: its content. */
function embeddingPage(host, more, within) {
  return `<!doctype html><title>embed</title><link rel="icon" href="data:,"><script type="module" src="${host}/tmpi-viewer.js"></script>
    <p>text</p><tmpi-viewer src="${host}/v1/photos/box/atlas" alt="A box before a wall" ${more}>${within ?? ''}</tmpi-viewer>`;
}
