// Describes how a photo got its depth.

import { decimal } from '../i18n/format.js';
import { t } from '../i18n/messages.js';

/** @typedef {{depth_model: string, stages: {name: string, ms: number}[], input: {depth?: {stretched: boolean} | null, depth_problem?: string | null}}} Report */

/** Common names of networks; others are shown as they are. */
/** @type {[RegExp, string][]} */
const NETWORKS = [
  [/^tmpi$/, 'the built-in network'],
  [/^moge-2/, 'MoGe-2'],
  [/^depth-anything-3/, 'Depth Anything 3'],
  [/^depth-anything-v2-small/, 'Depth Anything V2 Small'],
  [/^depth-anything-v2-metric/, 'Depth Anything V2, metric'],
  [/^depth-anything-v2/, 'Depth Anything V2'],
  [/^midas-v2\.1/, 'MiDaS 2.1'],
  [/^dpt-large/, 'DPT Large'],
  [/^dpt-hybrid/, 'DPT Hybrid'],
];

/**
 * The common name of a network, in English.
 * @param {string} model
 */
export const networkName = (model) => NETWORKS.find(([pattern]) => pattern.test(model))?.[1] ?? model;

/**
 * A few sentences for the menu.
 * @param {Report} report
 */
export function depthSummary({ depth_model: model, input, stages }) {
  const parts = [];
  if (model === 'given') parts.push(t('Depth: a map of your own.'));
  else if (model === 'embedded') parts.push(t('Depth: from the photo itself.'));
  else {
    const ms = stages.find((stage) => stage.name === 'depth')?.ms ?? 0;
    parts.push(t('Depth: estimated by {0} in {1} s.', t(networkName(model)), decimal(ms / 1000, ms < 995 ? 2 : 1)));
  }
  if (input.depth?.stretched) parts.push(t('The map has another shape than the photo and was stretched.'));
  if (input.depth_problem) parts.push(t('The photo’s own depth was left out: {0}', input.depth_problem));
  return parts.join(' ');
}
