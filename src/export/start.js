function start(modules, assets, entry) {
  const made = {};
  const use = (name) => (made[name] ??= modules[name](use, async (later) => use(later), asset));
  // a module's address is that of a worker, which gets the same modules; one from disk may load nothing but a data address
  function asset(name) {
    if (!(name in modules)) return new URL(assets[name]);
    const all = Object.entries(modules).map(([key, make]) => `${JSON.stringify(key)}: ${make}`);
    const text = `${start}\nstart({${all.join(',\n')}}, ${JSON.stringify(assets)}, ${JSON.stringify(name)});`;
    return new URL(`data:text/javascript;charset=utf-8,${encodeURIComponent(text)}`);
  }
  return use(entry);
}
