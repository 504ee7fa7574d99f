// Tests that cannot run here.
import { appendFileSync } from 'node:fs';

/**
 * Skips the test, unless TMPI_REQUIRE names what is missing; the file that TMPI_SKIPPED names is told: what is missing, the test and why, between tabs.
 * @param {import('node:test').TestContext} t
 * @param {'gpu' | 'onnx' | 'ffmpeg' | 'data' | 'chromium' | 'other'} need what is missing
 * @param {string} reason
 */
export function skip(t, need, reason) {
  const { TMPI_SKIPPED: list, TMPI_REQUIRE: required = '' } = process.env;
  if (required.split(',').includes(need)) throw new Error(`${need} is required: ${reason}`);
  if (list) appendFileSync(list, `${need}\tbrowser: ${t.name}\t${reason}\n`);
  t.skip(reason);
}
