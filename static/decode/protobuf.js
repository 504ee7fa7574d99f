// Reader of the protobuf wire format, as far as proto/tmpi.proto needs it. Trusts nothing in the bytes.

/** Bytes that are no container, or one that this program cannot read. */
export class ContainerError extends Error {
  constructor(message) {
    super(message);
    this.name = 'ContainerError';
  }
}

/** Throws a ContainerError. */
export function broken(what) {
  throw new ContainerError(`not a readable TMPI container: ${what}`);
}

/** Walks the fields of one message. */
export class Reader {
  /** @param {Uint8Array} bytes exactly one message */
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = 0;
  }

  /** Unsigned varint up to 2^53 - 1. */
  varint() {
    let value = 0;
    let scale = 1;
    for (let i = 0; i < 10; i++) {
      if (this.at >= this.bytes.length) broken('number cut off');
      const byte = this.bytes[this.at++];
      value += (byte & 127) * scale;
      if (value > Number.MAX_SAFE_INTEGER) broken('number too large');
      if (byte < 128) return value;
      scale *= 128;
    }
    return broken('number too long');
  }

  /** Little-endian f64. */
  double() {
    if (this.bytes.length - this.at < 8) broken('number cut off');
    const value = this.view.getFloat64(this.at, true);
    this.at += 8;
    return value;
  }

  /** Length-delimited bytes, as a view. */
  chunk() {
    const length = this.varint();
    if (length > this.bytes.length - this.at) broken('field longer than the message');
    this.at += length;
    return this.bytes.subarray(this.at - length, this.at);
  }

  /** Steps over a field of wire type `type` that this reader does not know. */
  skip(type) {
    if (type === 0) this.varint();
    else if (type === 1) this.double();
    else if (type === 2) this.chunk();
    else if (type === 5) {
      if (this.bytes.length - this.at < 4) broken('number cut off');
      this.at += 4;
    } else broken(`wire type ${type}`);
  }
}

const WIRE = { u32: 0, u64: 0, double: 1, message: 2 };

/**
 * Reads one message. `fields` maps field numbers to `[name, kind]`, kind being `u32`, `u64`, `double`, or the fields of a
 * repeated message. Missing numbers are 0, as proto3 says; unknown fields are ignored.
 */
export function readMessage(bytes, fields) {
  const out = {};
  for (const [name, kind] of Object.values(fields)) out[name] = typeof kind === 'string' ? 0 : [];
  const reader = new Reader(bytes);
  while (reader.at < bytes.length) {
    const tag = reader.varint();
    const number = Math.floor(tag / 8);
    const type = tag % 8;
    if (number === 0) broken('field number 0');
    const field = fields[number];
    if (!field) {
      reader.skip(type);
      continue;
    }
    const [name, kind] = field;
    if (type !== (WIRE[kind] ?? WIRE.message)) broken(`field ${name} has wire type ${type}`);
    if (kind === 'double') out[name] = reader.double();
    else if (kind === 'u64') out[name] = reader.varint();
    else if (kind === 'u32') out[name] = reader.varint() % 2 ** 32;
    else out[name].push(readMessage(reader.chunk(), kind));
  }
  return out;
}
