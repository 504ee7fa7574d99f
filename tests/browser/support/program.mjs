// Runs the built program as a server.
import { spawn } from 'node:child_process';
import { existsSync, mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';
import { until } from './until.mjs';

const root = fileURLToPath(new URL('../../../', import.meta.url));
export const program = resolve(process.env.TMPI_BIN || join(root, 'target/release/tmpi'));
/** tmpi-lab, built beside the program by cargo build --release --workspace. */
export const lab = join(dirname(program), 'tmpi-lab');
const START_MS = 30_000;

/** Starts `tmpi serve` on a free port: `{url, close}`; `more`: further arguments. */
export async function startServer(more = []) {
  if (!existsSync(program)) throw new Error(`no program at ${program}: build it with cargo build --release, or set TMPI_BIN`);
  const data = mkdtempSync(join(tmpdir(), 'tmpi-browser-'));
  const args = ['serve', '--addr', '127.0.0.1:0', '--depth-model', 'tmpi', '--data', data, ...more];
  // to change pages without a build
  if (process.env.TMPI_STATIC) args.push('--static', resolve(process.env.TMPI_STATIC));
  const child = spawn(program, args, { cwd: root, stdio: ['ignore', 'pipe', 'pipe'] });
  let log = '';
  child.stderr.on('data', (text) => (log += text));
  const url = await new Promise((resolve, reject) => {
    let out = '';
    const timer = setTimeout(() => reject(new Error(`the server printed no address\n${log}`)), START_MS);
    child.on('exit', (code) => reject(new Error(`the server exited with ${code}\n${log}`)));
    child.stdout.on('data', (text) => {
      out += text;
      const address = out.match(/http:\/\/[\d.:]+/);
      if (!address) return;
      clearTimeout(timer);
      resolve(address[0]);
    });
  });
  const close = async () => {
    const exited = new Promise((resolve) => child.once('exit', resolve));
    child.kill('SIGTERM');
    await exited;
    rmSync(data, { recursive: true, force: true });
  };
  return { url, close };
}

/** Uploads a photo, optionally with a depth map, and waits until it is made. */
export async function makePhoto(url, photo, depth) {
  const form = new FormData();
  form.append('photo', new Blob([photo], { type: 'image/png' }), 'photo.png');
  if (depth) form.append('depth', new Blob([depth], { type: 'image/png' }), 'depth.png');
  const response = await fetch(`${url}/v1/photos`, { method: 'POST', body: form, headers: { prefer: 'wait=25' } });
  let state = await response.json();
  if (!response.ok) throw new Error(JSON.stringify(state));
  await until(async () => {
    if (state.state !== 'queued' && state.state !== 'working') return true;
    state = await (await fetch(`${url}/v1/photos/${state.id}`)).json();
    return false;
  });
  if (state.state !== 'done') throw new Error(JSON.stringify(state));
  return state;
}
