// Skips tests that cannot run on this machine.
import { appendFileSync } from 'node:fs';

/**
 * Skips the test, or fails if TMPI_REQUIRE lists `need`. Appends need, test and reason, separated by tabs, to the file in TMPI_SKIPPED.
 * @param {import('node:test').TestContext} t
 * @param {'ffmpeg' | 'data'} need what is missing
 * @param {string} reason
 */
export function skip(t, need, reason) {
  const { TMPI_SKIPPED: list, TMPI_REQUIRE: required = '' } = process.env;
  if (required.split(',').includes(need)) throw new Error(`${need} is required: ${reason}`);
  if (list) appendFileSync(list, `${need}\tbrowser: ${t.name}\t${reason}\n`);
  t.skip(reason);
}
