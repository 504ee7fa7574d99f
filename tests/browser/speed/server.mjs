// Serves static/ as /wasm/, and containers.
import { createReadStream, readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { extname, join } from 'node:path';
import { fileURLToPath } from 'node:url';
import { WORKER } from './decode.mjs';

export const STATIC = fileURLToPath(new URL('../../../static/', import.meta.url));
const TYPES = { '.js': 'text/javascript', '.wasm': 'application/wasm', '.wgsl': 'text/wgsl' };
const PAGE = '<!doctype html><title>speed</title><link rel="icon" href="data:," />';
const STAGE = `${PAGE}<div id="stage" tabindex="0" style="width: 100vw; height: 90vh"></div>`;

/** @param {string[]} files containers, at /file/NUMBER */
export async function startSpeedServer(files) {
  const server = createServer((request, response) => {
    const path = decodeURIComponent(new URL(request.url, 'http://x').pathname);
    const reply = (type, body) => response.writeHead(200, { 'content-type': type }).end(body);
    if (path === '/') return reply('text/html', PAGE);
    if (path === '/wasm/stage') return reply('text/html', STAGE);
    if (path === '/worker.js') return reply('text/javascript', WORKER);
    if (path.startsWith('/file/')) return reply('application/octet-stream', readFileSync(files[Number(path.slice(6))]));
    return createReadStream(join(STATIC, path.replace(/^\/wasm\//, '')))
      .on('error', () => response.writeHead(404).end())
      .once('open', () => response.writeHead(200, { 'content-type': TYPES[extname(path)] ?? 'text/plain' }))
      .pipe(response);
  });
  await new Promise((ready) => server.listen(0, '127.0.0.1', ready));
  return { address: `http://127.0.0.1:${server.address().port}/`, close: () => server.close() };
}
