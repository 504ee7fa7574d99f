// A client of tmpi's HTTP interface, for browsers and Node 20 or newer, built on `fetch` alone. Types: rest-client.d.ts.
//
// Reads, and uploads with credentials, are retried after a broken connection, after silence, and after 429 and 503. Other requests are
// retried only after 429, where the server did nothing. `Retry-After` is honoured.

const MIB = 1 << 20;
const JSON_BYTES = 16 * MIB;
const PROBLEM_BYTES = 64 << 10;
const EVENT_CHARACTERS = MIB;
/** Pause before the second try. */
const FIRST_PAUSE_MS = 250;
/** An export may take this long, without any data meanwhile. */
const EXPORT_MS = 600_000;
/** Minimum bytes per millisecond that the server accepts for an upload. */
const SLOWEST = 8;
const ENDS = new Set(['done', 'failed', 'damaged', 'deleted']);

/** Why there is no answer; `reason` tells which kind. */
export class TmpiError extends Error {
  /**
   * @param {import('./rest-client.js').Reason} reason
   * @param {string} message
   * @param {import('./rest-client.js').Problem} [problem]
   */
  constructor(reason, message, problem) {
    super(message);
    this.name = 'TmpiError';
    this.reason = reason;
    this.problem = problem;
    this.status = problem?.status;
  }
}

/** @param {number} ms @param {AbortSignal} [signal] */
function sleep(ms, signal) {
  return new Promise((resolve, reject) => {
    signal?.throwIfAborted();
    const stop = () => {
      clearTimeout(timer);
      reject(signal?.reason);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener('abort', stop);
      resolve(undefined);
    }, ms);
    signal?.addEventListener('abort', stop, { once: true });
  });
}

/** Aborts after a while without data, or when the caller aborts. */
class Patience {
  /** @param {number} ms @param {AbortSignal} [outer] */
  constructor(ms, outer) {
    this.ms = ms;
    this.outer = outer;
    this.controller = new AbortController();
    this.stop = () => this.controller.abort(outer?.reason);
    if (outer?.aborted) this.stop();
    outer?.addEventListener('abort', this.stop, { once: true });
    this.renew();
  }

  renew() {
    clearTimeout(this.timer);
    const late = () => this.controller.abort(new TmpiError('silence', `nothing came for ${this.ms / 1000} s`));
    this.timer = setTimeout(late, this.ms);
  }

  end() {
    clearTimeout(this.timer);
    this.outer?.removeEventListener('abort', this.stop);
  }
}

/** @param {Response} response @param {number} most @param {Patience} patience */
async function read(response, most, patience) {
  const tooLarge = () => new TmpiError('too-large', `the answer has more than ${most} bytes`);
  if (Number(response.headers.get('content-length')) > most) {
    await response.body?.cancel();
    throw tooLarge();
  }
  const chunks = [];
  let length = 0;
  const reader = response.body?.getReader();
  while (reader) {
    const { done, value } = await reader.read();
    if (done) break;
    patience.renew();
    length += value.length;
    if (length > most) {
      await reader.cancel();
      throw tooLarge();
    }
    chunks.push(value);
  }
  const bytes = new Uint8Array(length);
  let at = 0;
  for (const chunk of chunks) {
    bytes.set(chunk, at);
    at += chunk.length;
  }
  return bytes;
}

/** @param {Uint8Array} bytes */
function parsed(bytes) {
  try {
    return JSON.parse(new TextDecoder().decode(bytes));
  } catch (error) {
    throw new TmpiError('answer', `an answer that is not understood: ${error.message}`);
  }
}

/** @param {Response} response @param {Uint8Array} bytes */
function problemOf(response, bytes) {
  const { status, statusText } = response;
  let problem;
  try {
    problem = JSON.parse(new TextDecoder().decode(bytes));
  } catch {
    // a proxy between here and the server answered
  }
  if (typeof problem?.title !== 'string')
    problem = { type: 'about:blank', title: statusText, detail: new TextDecoder().decode(bytes.subarray(0, 256)) };
  const header = Number.parseInt(response.headers.get('retry-after') ?? '', 10);
  if (problem.retry_after === undefined && header >= 0) problem.retry_after = header;
  problem.status = status;
  return problem;
}

/** The text of an attribute's value. @param {string} text */
function quoted(text) {
  return text.replaceAll('&', '&amp;').replaceAll('"', '&quot;').replaceAll('<', '&lt;');
}

/** Whole events of a stream's text, and what is left of it. @param {string} text */
function blocks(text) {
  const parts = text.replaceAll('\r\n', '\n').split('\n\n');
  const rest = parts.pop() ?? '';
  const events = parts.map((part) => {
    const lines = part.split('\n');
    const values = (/** @type {string} */ field) =>
      lines.filter((line) => line.startsWith(`${field}:`)).map((line) => line.slice(field.length + 1).replace(/^ /, ''));
    return { type: values('event').at(-1), data: values('data').join('\n') };
  });
  return { events, rest };
}

/** A server, as one caller sees it. */
export class Tmpi {
  /** @param {string} base @param {import('./rest-client.js').ClientOptions} [options] */
  constructor(base, options = {}) {
    this.base = new URL(base);
    if (!/^https?:$/.test(this.base.protocol)) throw new TmpiError('input', `not the address of a server: ${base}`);
    const { key, ownerLink, manageLink, silence = 60_000, longestPause = 30_000, tries = 4, maxBytes = 512 * MIB } = options;
    const secret = ownerLink === undefined ? undefined : /#owner=(tmpi_o_[\w-]+)$/.exec(ownerLink)?.[1];
    if (ownerLink !== undefined && !secret) throw new TmpiError('input', "an owner's link ends with #owner= and a secret");
    const token = manageLink === undefined ? undefined : /#manage=(tmpi_m_[0-9a-f]{64})$/.exec(manageLink)?.[1];
    if (manageLink !== undefined && !token)
      throw new TmpiError('input', "a link to change a photo ends with #manage= and the photo's token");
    this.limits = { silence, longestPause, tries, maxBytes };
    const bearer = key ?? secret ?? token;
    this.authorization = bearer && `Bearer ${bearer}`;
  }

  /** Address of a path that the server returned. @param {string} path */
  address(path) {
    const below = this.base.pathname.replace(/\/$/, '');
    const url = new URL(path.startsWith(`${below}/`) ? path : below + path, this.base);
    if (url.origin !== this.base.origin) throw new TmpiError('answer', `${path} is of another server`);
    return url.href;
  }

  /**
   * @param {string} path
   * @param {{method?: string, query?: object, headers?: Record<string, string>, body?: BodyInit, silence?: number, safe?: boolean, signal?: AbortSignal}} call
   * @param {(response: Response, patience: Patience) => Promise<any>} take
   */
  async ask(path, call, take) {
    const { method = 'GET', query = {}, headers = {}, body, signal } = call;
    const safe = call.safe ?? method === 'GET';
    const url = new URL(this.address(path));
    for (const [name, value] of Object.entries(query)) if (value !== undefined) url.searchParams.set(name, String(value));
    const all = { ...headers, ...this.own() };
    for (let tries = 1; ; tries++) {
      const patience = new Patience(call.silence ?? this.limits.silence, signal);
      let error;
      try {
        const response = await fetch(url, { method, headers: all, body, redirect: 'error', signal: patience.controller.signal });
        patience.renew();
        if (response.ok || response.status === 304) return await take(response, patience);
        const problem = problemOf(response, await read(response, PROBLEM_BYTES, patience));
        error = new TmpiError('refused', `${problem.status} ${problem.title}: ${problem.detail}`, problem);
      } catch (thrown) {
        signal?.throwIfAborted();
        error =
          thrown instanceof TmpiError ? thrown : new TmpiError('connection', `no connection: ${thrown.cause?.message ?? thrown.message}`);
      } finally {
        patience.end();
      }
      const broken = error.reason === 'connection' || error.reason === 'silence' || error.status === 503;
      const asked = 1000 * (error.problem?.retry_after ?? 0);
      const again = error.status === 429 || (safe && broken);
      if (!again || tries >= this.limits.tries || asked > this.limits.longestPause) throw error;
      await sleep(Math.max(asked, this.pause(tries)), signal);
    }
  }

  /** Pause before another try, spread so that clients refused together do not return together. @param {number} tries */
  pause(tries) {
    return Math.min(FIRST_PAUSE_MS * 2 ** (tries - 1), this.limits.longestPause) * (0.5 + Math.random() / 2);
  }

  /** @param {string} id @param {string} part */
  photo(id, part = '') {
    if (!/^[0-9a-f]{32}$/i.test(id)) throw new TmpiError('input', `no id of a photo: ${id}`);
    return `/v1/photos/${id}${part}`;
  }

  /** @param {string} path @param {object} [call] */
  async json(path, call = {}) {
    return this.ask(path, call, async (response, patience) => parsed(await read(response, JSON_BYTES, patience)));
  }

  /** @param {string} path @param {object} [call] */
  async tagged(path, call = {}) {
    return this.ask(path, call, async (response, patience) => ({
      value: parsed(await read(response, JSON_BYTES, patience)),
      etag: response.headers.get('etag'),
    }));
  }

  /** @param {string} path @param {object} [call] */
  async file(path, call = {}) {
    return this.ask(path, call, async (response, patience) =>
      response.status === 304
        ? null
        : {
            bytes: await read(response, this.limits.maxBytes, patience),
            mediaType: response.headers.get('content-type') ?? '',
            etag: response.headers.get('etag'),
          },
    );
  }

  /** @param {Blob | ArrayBuffer | Uint8Array<ArrayBuffer>} photo @param {import('./rest-client.js').UploadOptions} [options] */
  async upload(photo, { title, visibility, depth, options = {}, wait = 0, signal } = {}) {
    const blob = photo instanceof Blob ? photo : new Blob([photo]);
    const fields = { ...options, title, visibility };
    /** @type {Record<string, string>} */
    const headers = wait >= 1 ? { prefer: `wait=${Math.floor(wait)}` } : {};
    const size = blob.size + (depth instanceof Blob ? depth.size : (depth?.byteLength ?? 0));
    const call = { method: 'POST', headers, safe: Boolean(this.authorization), signal };
    const silence = this.limits.silence + wait * 1000 + size / SLOWEST;
    // in a form, an unnamed photo would be sent under the file name `blob`
    if (!depth && !(photo instanceof File)) {
      const type = 'application/octet-stream';
      return this.json('/v1/photos', { ...call, headers: { ...headers, 'content-type': type }, silence, query: fields, body: blob });
    }
    const form = new FormData();
    for (const [field, value] of Object.entries(fields)) if (value !== undefined) form.append(field, String(value));
    form.append('photo', blob, photo instanceof File ? photo.name : 'photo');
    if (depth) form.append('depth', depth instanceof Blob ? depth : new Blob([depth]), 'depth');
    return this.json('/v1/photos', { ...call, silence, body: form });
  }

  /** The `Authorization` header, if there is one. @returns {Record<string, string>} */
  own() {
    return this.authorization ? { authorization: this.authorization } : {};
  }

  /** @param {string} id */
  async state(id) {
    return this.tagged(this.photo(id));
  }

  /** @param {string} id @param {{signal?: AbortSignal}} [options] */
  async *events(id, { signal } = {}) {
    const opened = await this.ask(this.photo(id, '/events'), { signal }, async (response) => response);
    // the stream has its own patience: the request's ended with the response's head
    const reader = opened.body.getReader();
    const decoder = new TextDecoder();
    let text = '';
    try {
      for (;;) {
        const { done, value } = await this.within(reader.read(), signal);
        if (done) return;
        const found = blocks(text + decoder.decode(value, { stream: true }));
        text = found.rest;
        if (text.length > EVENT_CHARACTERS) throw new TmpiError('too-large', `an event has more than ${EVENT_CHARACTERS} characters`);
        for (const { type, data } of found.events) if (type) yield { type, data: JSON.parse(data) };
      }
    } finally {
      await reader.cancel().catch(() => {});
    }
  }

  /** @template T @param {Promise<T>} promise @param {AbortSignal} [signal] @returns {Promise<T>} */
  async within(promise, signal) {
    const patience = new Patience(this.limits.silence, signal);
    const { signal: late } = patience.controller;
    /** @type {Promise<never>} */
    const end = new Promise((_, reject) => {
      if (late.aborted) reject(late.reason);
      late.addEventListener('abort', () => reject(late.reason), { once: true });
    });
    return Promise.race([promise, end]).finally(() => patience.end());
  }

  /** @param {string} id @param {import('./rest-client.js').WaitOptions} [options] */
  async wait(id, { limit = 600_000, signal, onEvent } = {}) {
    const late = AbortSignal.timeout(limit);
    const both = signal ? AbortSignal.any([signal, late]) : late;
    const notMade = (/** @type {any} */ problem) => new TmpiError('not-made', `the photo is not made: ${problem?.detail}`, problem);
    try {
      for (let rounds = 1; ; rounds++) {
        try {
          for await (const event of this.events(id, { signal: both })) {
            rounds = 1;
            onEvent?.(event);
            if (!ENDS.has(event.type)) continue;
            if (event.type === 'done') return event.data;
            throw event.type === 'deleted' ? new TmpiError('deleted', 'the photo was deleted') : notMade(event.data);
          }
        } catch (error) {
          both.throwIfAborted();
          // a missing photo stays missing; after any other failure of the events, the state may still be available
          if (!(error instanceof TmpiError) || ['not-made', 'deleted', 'input'].includes(error.reason) || Number(error.status) < 429)
            throw error;
        }
        const { value } = await this.tagged(this.photo(id), { signal: both });
        if (value.state === 'done') return value;
        if (value.state === 'failed' || value.state === 'damaged') throw notMade(value.problem);
        await sleep(Math.min(this.pause(rounds), 10_000), both);
      }
    } catch (error) {
      if (late.aborted && !signal?.aborted) throw new TmpiError('late', `the photo is not made after ${limit / 1000} s`);
      throw error;
    }
  }

  /** @param {{limit?: number, after?: string}} [query] */
  async list(query = {}) {
    return this.json('/v1/photos', { query });
  }

  /** @param {number} [limit] */
  async *photos(limit) {
    for (let page = await this.list({ limit }); ; page = await this.json(page.next)) {
      yield* page.photos;
      if (!page.next) return;
    }
  }

  /** @param {string} id */
  async report(id) {
    return this.json(this.photo(id, '/report'));
  }

  /** @param {string} path @param {object} patch @param {string} [seen] */
  async patch(path, patch, seen) {
    /** @type {Record<string, string>} */
    const headers = { 'content-type': 'application/merge-patch+json' };
    if (seen) headers['if-match'] = seen;
    return this.tagged(path, { method: 'PATCH', headers, body: JSON.stringify(patch) });
  }

  /** @param {string} id @param {object} settings @param {string} [seen] */
  async change(id, settings, seen) {
    return this.patch(this.photo(id), settings, seen);
  }

  /** @param {string} id */
  async strokes(id) {
    return this.tagged(this.photo(id, '/strokes'));
  }

  /** @param {string} id @param {object[]} strokes @param {string} [seen] */
  async touchUp(id, strokes, seen) {
    return this.patch(this.photo(id, '/strokes'), { strokes }, seen);
  }

  /** @param {string} id @param {number} [seconds] */
  async link(id, seconds) {
    // the server stores nothing for a link
    return this.json(this.photo(id, '/links'), { method: 'POST', query: { seconds }, safe: true });
  }

  /** @param {string} id */
  async takeLinksBack(id) {
    await this.ask(this.photo(id, '/manage'), { method: 'DELETE' }, async () => undefined);
  }

  /** @param {string} id */
  async delete(id) {
    await this.ask(this.photo(id), { method: 'DELETE' }, async () => undefined);
  }

  /** @param {string} id @param {import('./rest-client.js').AtlasQuery} [query] @param {string} [etag] */
  async atlas(id, { sections, region, ...query } = {}, etag) {
    const all = { ...query, sections: sections?.join(','), region: region?.join(',') };
    return this.file(this.photo(id, '/atlas'), { query: all, headers: etag ? { 'if-none-match': etag } : {} });
  }

  /** @param {string} id @param {import('./rest-client.js').ViewQuery} [query] */
  async view(id, { crop, ...query } = {}) {
    return this.file(this.photo(id, '/view'), { query: { ...query, crop: crop?.join(',') } });
  }

  /** @param {string} id @param {'html' | 'glb' | 'ora' | 'zip'} [format] @param {'relief' | 'metric'} [shape] */
  async export(id, format, shape) {
    return this.file(this.photo(id, '/export'), { query: { format, shape }, silence: this.limits.silence + EXPORT_MS });
  }

  /** @param {string} id */
  async thumbnail(id) {
    return this.file(this.photo(id, '/thumbnail'));
  }

  /** @param {string} id */
  async depth(id) {
    return this.file(this.photo(id, '/depth'));
  }

  /** @param {import('./rest-client.js').PhotoState} state @param {import('./rest-client.js').PhotoLink} [link] */
  embed(state, link) {
    const address = `${this.address(state.links.embed)}${link?.query ? `?${link.query}` : ''}`;
    return `<iframe src="${quoted(address)}" title="${quoted(state.settings.title ?? '3D photo')}" allow="fullscreen"></iframe>`;
  }
}
