// Conversion to 16-bit floats.

/**
 * Bits of the 16-bit float that is nearest to a number from 0 to 1.
 * @param {number} value
 */
export function halfBits(value) {
  if (value <= 0) return 0;
  // 2⁻¹⁴ is the smallest exponent; smaller numbers are subnormal
  const exponent = Math.max(-14, Math.floor(Math.log2(value)));
  return ((exponent + 14) << 10) + Math.round(value * 2 ** (10 - exponent));
}

/**
 * Table of the bits of `value · alpha` for all pairs of bytes (0 to 255 stand for 0 to 1), at index `value · 256 + alpha`.
 * @returns {Uint16Array<ArrayBuffer>}
 */
export function premultipliedHalves() {
  const out = new Uint16Array(65_536);
  for (let value = 0; value < 256; value++) {
    for (let alpha = 0; alpha < 256; alpha++) out[value * 256 + alpha] = halfBits((value * alpha) / 65_025);
  }
  return out;
}

/**
 * Converts straight RGBA to premultiplied 16-bit floats.
 * @param {Uint8Array} bytes
 * @param {Uint16Array} table of `premultipliedHalves`
 */
export function inHalves(bytes, table) {
  const out = new Uint16Array(bytes.length);
  for (let i = 0; i < bytes.length; i += 4) {
    const alpha = bytes[i + 3];
    if (alpha === 0) continue;
    for (let c = 0; c < 3; c++) out[i + c] = table[bytes[i + c] * 256 + alpha];
    out[i + 3] = table[255 * 256 + alpha];
  }
  return out;
}
