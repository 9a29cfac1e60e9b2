/** Planned and executed motion as samples: computed when asked for, a stretch of the print at a time. */

import { computed, isAbort } from "../lib/api.js";
import { fill, h } from "../lib/dom.js";
import { save } from "../lib/files.js";
import { problemPanel } from "../lib/problem.js";

const LONGEST_S = 600;

/**
 * @param {any} job
 * @param {AbortSignal} signal
 * @returns {HTMLElement | null}
 */
export function trajectories(job, signal) {
  const where = job.links.trajectories;
  if (!where) return null;
  const start = h("input", { type: "number", id: "start", min: "0", step: "any", value: "0", required: true });
  const length = h("input", { type: "number", id: "length", min: "0.001", max: String(LONGEST_S), step: "any", value: "60", required: true });
  const format = h("select", { id: "format" }, h("option", { value: "csv" }, "CSV"), h("option", { value: "npz" }, "NumPy (npz)"));
  const send = h("button", { type: "submit" }, "Compute and download");
  const status = h("div", { "aria-live": "polite" });
  const stem = job.result_name.replace(/\.[^.]*$/, "");
  const form = h("form", { onsubmit: async (/** @type {Event} */ event) => {
    event.preventDefault();
    send.disabled = true;
    fill(status, h("p.row", null, h("progress", { "aria-label": "Computing" }), "Computing; this takes as long as compensating the file up to there …"));
    try {
      const query = { format: format.value, start_s: start.value, stop_s: String(Number(start.value) + Number(length.value)) };
      save(await (await computed(where, { query, signal })).blob(), `${stem}.${start.value}s.${format.value}`);
      fill(status);
    } catch (error) {
      if (!isAbort(error)) fill(status, problemPanel(error));
    }
    send.disabled = false;
  } },
    h("p.hint", null, `A row for every millisecond: where the nozzle was planned to be, where it was sent, and where the model says it went. At most ${LONGEST_S} s at a time.`),
    h("div.fields", null,
      h("div.field", null, h("label", { for: "start" }, "From, s of the print"), start),
      h("div.field", null, h("label", { for: "length" }, "Length, s"), length),
      h("div.field", null, h("label", { for: "format" }, "Format"), format)),
    h("div.actions", null, send), status);
  return h("section", null, h("details", { id: "trajectories" }, h("summary", null, "Trajectories as CSV"), form));
}

/** Open the form, and go there. */
export function openTrajectories() {
  const details = /** @type {HTMLDetailsElement | null} */ (document.getElementById("trajectories"));
  if (details === null) return;
  details.open = true;
  details.scrollIntoView({ block: "center" });
  details.querySelector("input")?.focus({ preventScroll: true });
}
