function start(modules, assets, entry) {
  const loaded = {};
  const use = (name) => (loaded[name] ??= modules[name](use, async (later) => use(later), asset));
  // a module's URL is that of a worker with the same modules; a page from disk can load a worker only from a data URL
  function asset(name) {
    if (!(name in modules)) return new URL(assets[name]);
    const all = Object.entries(modules).map(([key, make]) => `${JSON.stringify(key)}: ${make}`);
    const text = `${start}\nstart({${all.join(',\n')}}, ${JSON.stringify(assets)}, ${JSON.stringify(name)});`;
    return new URL(`data:text/javascript;charset=utf-8,${encodeURIComponent(text)}`);
  }
  return use(entry);
}
