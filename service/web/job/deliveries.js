/** What goes out when a job is over: the file to a printer, and a notification. */

import { getJson, isAbort } from "../lib/api.js";
import { fill, h } from "../lib/dom.js";
import { problemPanel } from "../lib/problem.js";
import { pause } from "../lib/watch.js";

const ASK_AFTER_MS = 1000;
const SLOWEST_MS = 30_000;

/**
 * Say how it stands with a job's deliveries until all have ended.
 *
 * @param {Element} panel
 * @param {any} job
 * @param {AbortSignal} signal
 */
export async function showDeliveries(panel, job, signal) {
  if (!job.printer && !job.webhook) return;
  try {
    for (let wait = ASK_AFTER_MS; ; wait = Math.min(1.5 * wait, SLOWEST_MS)) {
      if (await isSettled(panel, job, signal)) return;
      await pause(wait, signal);
    }
  } catch (error) {
    if (!isAbort(error)) fill(panel, problemPanel(error));
  }
}

/** Show how it stands now. @param {Element} panel @param {any} job @param {AbortSignal} signal @returns {Promise<boolean>} */
async function isSettled(panel, job, signal) {
  try {
    // Events of a job come without its deliveries.
    const { deliveries } = await getJson(`/v1/jobs/${job.id}`, { signal });
    fill(panel, deliveries.length ? h("ul.notice", { "aria-label": "Sent on" },
      deliveries.map((/** @type {any} */ each) => h("li", null, sentence(job, each)))) : null);
    return deliveries.every((/** @type {any} */ each) => ["done", "failed"].includes(each.state));
  } catch (/** @type {any} */ error) {
    if (isAbort(error) || [401, 403, 404].includes(error.status)) throw error;
    fill(panel, h("p.hint", null, "The service does not answer; it is asked again until it does."));
    return false;
  }
}

/** @param {any} job @param {any} delivery @returns {string} */
function sentence(job, { kind, target, state, error }) {
  const isPrinter = kind === "printer";
  const where = isPrinter ? `the printer ${target}` : target;
  // A note of a file that arrived says why it was not started, or what differs at the printer.
  const why = error ? `: ${error}` : "";
  if (state === "failed") return `Sending to ${where} failed${why}`;
  if (state !== "done") return `Sending to ${where}${why} …`;
  return `Sent to ${where}${why || (isPrinter && job.print ? ", which was told to print it" : "")}`;
}
