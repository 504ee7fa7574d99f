// Tests that cannot run here.
import { appendFileSync } from 'node:fs';

/**
 * Skips the test, and says so in the file that TMPI_SKIPPED names, where it names one: what is missing, the test and why, between tabs.
 * @param {import('node:test').TestContext} t
 * @param {'gpu' | 'onnx' | 'ffmpeg' | 'data' | 'chromium' | 'other'} need what is missing
 * @param {string} reason
 */
export function skip(t, need, reason) {
  const { TMPI_SKIPPED: list } = process.env;
  if (list) appendFileSync(list, `${need}\tbrowser: ${t.name}\t${reason}\n`);
  t.skip(reason);
}
