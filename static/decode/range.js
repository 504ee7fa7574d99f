// Adaptive binary range coder. The server's src/atlas/range.rs, step by step; all on integers.

const QUICK = 4;
const SLOW = 7;

/** Adaptive binary range decoder; reads zeros past the end. */
export class RangeDecoder {
  constructor(bytes) {
    this.bytes = bytes;
    this.at = 0;
    this.code = 0;
    this.range = 0xffff_ffff;
    for (let i = 0; i < 4; i++) this.code = ((this.code << 8) | this.next()) >>> 0;
  }

  next() {
    return this.at < this.bytes.length ? this.bytes[this.at++] : 0;
  }

  /** Reads a bit with the adaptive model at `i` of `models`. */
  bit(models, i) {
    const split = (this.range >>> 12) * share(models, i);
    const one = this.code < split;
    if (one) {
      this.range = split;
    } else {
      this.code -= split;
      this.range -= split;
    }
    learn(models, i, one);
    while (this.range < 0x100_0000) {
      this.range = (this.range << 8) >>> 0;
      this.code = ((this.code << 8) | this.next()) >>> 0;
    }
    return one;
  }
}

/** Share of the range that a 1 takes, in 1/4096; a model is a quick and a slow estimate side by side. */
export function share(models, i) {
  const sum = (models[i * 2] + models[i * 2 + 1]) >>> 5;
  return sum < 1 ? 1 : sum > 4095 ? 4095 : sum;
}

/** Moves both estimates of a model towards a bit. */
export function learn(models, i, one) {
  const at = i * 2;
  const [quick, slow] = [models[at], models[at + 1]];
  models[at] = one ? quick + ((0xffff - quick) >>> QUICK) : quick - (quick >>> QUICK);
  models[at + 1] = one ? slow + ((0xffff - slow) >>> SLOW) : slow - (slow >>> SLOW);
}

/** So many models that know nothing yet. */
export const models = (count) => new Uint16Array(count * 2).fill(0x8000);
