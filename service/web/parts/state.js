/** A job's state as a badge: a word, and a shape that does not rest on colour alone. */

import { h } from "../lib/dom.js";

const NAMES = { queued: "Waiting", running: "Running", done: "Done", failed: "Failed", cancelled: "Cancelled" };

/**
 * @param {string} state
 * @returns {HTMLElement}
 */
export function stateBadge(state) {
  const name = NAMES[/** @type {keyof typeof NAMES} */ (state)] ?? state;
  return h("span.badge", { dataset: { state } }, name);
}
