// React, Vue and Svelte for test pages, without a bundler: their files as modules, and components compiled by their own compilers.
import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { tmpdir } from 'node:os';
import { dirname, join, relative } from 'node:path';
import { compile } from 'svelte/compiler';
import { compileScript, parse } from 'vue/compiler-sfc';

const require = createRequire(import.meta.url);
const PACKAGES = join(import.meta.dirname, '../node_modules');
/** Prefix of addresses of the packages' files. */
const FILES = '/packages/';

/** What tests import of React's CommonJS modules. */
const REACT = {
  react: ['createElement', 'useEffect', 'useRef'],
  'react/jsx-runtime': ['jsx'],
  'react-dom': ['flushSync'],
  'react-dom/client': ['createRoot'],
};

/** CommonJS modules with all that they require; `renamed` gives other names to the packages that they require. */
class CommonJs {
  #sources = new Map();
  #renamed;

  constructor(renamed) {
    this.#renamed = renamed;
  }

  #add(path) {
    if (this.#sources.has(path)) return path;
    const source = readFileSync(path, 'utf8');
    this.#sources.set(path, '');
    const names = [...source.matchAll(/\brequire\(['"]([^'"]+)['"]\)/g)].map(([, name]) => name);
    const paths = Object.fromEntries(names.map((name) => [name, this.#add(createRequire(path).resolve(this.#name(name)))]));
    this.#sources.set(path, `[(module, exports, require, process) => {${source}\n}, ${JSON.stringify(paths)}]`);
    return path;
  }

  /** `react-18/jsx-runtime` of `react/jsx-runtime`. */
  #name(name) {
    const [first, ...rest] = name.split('/');
    return [this.#renamed[first] ?? first, ...rest].join('/');
  }

  /** Source of a module with some of the exports of `name`. */
  module(name, exported) {
    const path = this.#add(require.resolve(this.#name(name)));
    return `export const { ${exported.join(', ')} } = commonJs(${JSON.stringify(path)});`;
  }

  /** Source of the script that defines `commonJs`, which runs a module. */
  get script() {
    const modules = [...this.#sources].map(([path, source]) => `${JSON.stringify(path)}: ${source}`);
    return `{ const modules = {${modules.join(',\n')}}, made = {}, process = { env: { NODE_ENV: 'development' } };
      globalThis.commonJs = (path) => {
        if (made[path]) return made[path].exports;
        const [run, paths] = modules[path];
        const module = (made[path] = { exports: {} });
        run(module, module.exports, (name) => commonJs(paths[name]), process);
        return module.exports;
      } }`;
  }
}

/** Compiles JSX with TypeScript. */
function compileJsx(source) {
  const folder = mkdtempSync(join(tmpdir(), 'tmpi-jsx-'));
  try {
    writeFileSync(join(folder, 'photo.jsx'), source);
    const tsc = join(dirname(require.resolve('typescript/package.json')), 'bin/tsc');
    const options = ['--allowJs', '--noCheck', '--noResolve', '--jsx', 'react-jsx', '--module', 'esnext', '--target', 'esnext'];
    execFileSync(process.execPath, [tsc, ...options, '--moduleResolution', 'bundler', '--outDir', 'out', 'photo.jsx'], { cwd: folder });
    return readFileSync(join(folder, 'out/photo.js'), 'utf8');
  } finally {
    rmSync(folder, { recursive: true, force: true });
  }
}

/** React's harness; `show` draws a photo for each of the given props, in order, and `end` unmounts all. */
function react(component, renamed) {
  const common = new CommonJs(renamed);
  const modules = Object.fromEntries(Object.entries(REACT).map(([name, exported]) => [name, common.module(name, exported)]));
  return {
    head: `<script src="/common.js"></script>`,
    files: { '/common.js': common.script },
    modules: { ...modules, photo: compileJsx(component) },
    main: `import { createElement } from 'react';
      import { flushSync } from 'react-dom';
      import { createRoot } from 'react-dom/client';
      import Photo from 'photo';
      const root = createRoot(place);
      window.show = (all) => flushSync(() => root.render(all.map((props) => createElement(Photo, { key: props.alt, ...props, onLoad }))));
      window.end = () => root.unmount();`,
  };
}

function vue(component) {
  const { descriptor } = parse(component, { filename: 'Photo.vue' });
  const compilerOptions = { isCustomElement: (tag) => tag === 'tmpi-viewer' };
  const { content } = compileScript(descriptor, { id: 'photo', inlineTemplate: true, templateOptions: { compilerOptions } });
  return {
    modules: { photo: content },
    addresses: { vue: `${FILES}vue/dist/vue.runtime.esm-browser.js` },
    main: `import { createApp, h, nextTick, shallowRef } from 'vue';
      import Photo from 'photo';
      const photos = shallowRef([]);
      const app = createApp({ render: () => photos.value.map((props) => h(Photo, { key: props.alt, ...props, onLoad })) });
      app.mount(place);
      window.show = (all) => { photos.value = all; return nextTick(); };
      window.end = () => app.unmount();`,
  };
}

const LIST = `<script>
  import Photo from 'photo';
  const { onLoad } = $props();
  let photos = $state.raw([]);
  export const show = (all) => { photos = all; };
</script>
{#each photos as photo (photo.alt)}<Photo {...photo} onload={onLoad} />{/each}`;

/** Addresses of what a package exports, and of what its own modules import as `#name`. */
function addressesOf(name) {
  const folder = join(PACKAGES, name);
  const { exports, imports = {} } = JSON.parse(readFileSync(join(folder, 'package.json'), 'utf8'));
  const chosen = (target) =>
    typeof target === 'string' ? target : chosen(target.browser ?? target.development ?? target.import ?? target.default ?? '');
  const address = ([key, target]) => [key.startsWith('#') ? key : join(name, key), FILES + join(name, chosen(target))];
  return Object.fromEntries([...Object.entries(exports), ...Object.entries(imports)].map(address));
}

function svelte(component) {
  const compiled = (source, filename) => compile(source, { generate: 'client', dev: true, filename }).js.code;
  return {
    modules: { photo: compiled(component, 'Photo.svelte'), list: compiled(LIST, 'List.svelte') },
    addresses: { ...addressesOf('svelte'), ...addressesOf('esm-env'), ...addressesOf('clsx') },
    main: `import { flushSync, mount, unmount } from 'svelte';
      import List from 'list';
      const list = mount(List, { target: place, props: { onLoad } });
      window.show = (all) => { list.show(all); flushSync(); };
      window.end = () => unmount(list);`,
  };
}

/** The harness of a framework by name, with the component in that source. */
export const FRAMEWORKS = {
  'React 19': (component) => react(component, {}),
  'React 18': (component) => react(component, { react: 'react-18', 'react-dom': 'react-dom-18' }),
  Vue: vue,
  Svelte: svelte,
};

/** Serves a page at `/framework` with a harness, after the HTML `before`; `loads` counts `load` events. */
export async function routeFramework(page, { head = '', files = {}, modules, addresses = {}, main }, before) {
  const own = Object.fromEntries(Object.keys(modules).map((name, i) => [name, `/modules/${i}.js`]));
  const sources = { ...files, ...Object.fromEntries(Object.entries(own).map(([name, path]) => [path, modules[name]])) };
  const map = JSON.stringify({ imports: { ...addresses, ...own } });
  const html = `<!doctype html><title>a page</title><link rel="icon" href="data:,"><style>tmpi-viewer { width: 300px }</style>
    <script type="importmap">${map}</script>${head}${before}<div id="place"></div>
    <script type="module">const place = document.getElementById('place'); window.loads = 0; const onLoad = () => window.loads++; ${main}</script>`;
  const script = (route, body) => route.fulfill({ contentType: 'text/javascript', body });
  await page.route('**/framework', (route) => route.fulfill({ contentType: 'text/html', body: html }));
  await page.route(
    ({ pathname }) => pathname in sources,
    (route) => script(route, sources[new URL(route.request().url()).pathname]),
  );
  await page.route(`**${FILES}**`, (route) => {
    const path = join(PACKAGES, new URL(route.request().url()).pathname.slice(FILES.length));
    if (relative(PACKAGES, path).startsWith('..')) return route.abort();
    return script(route, readFileSync(path, 'utf8'));
  });
}
