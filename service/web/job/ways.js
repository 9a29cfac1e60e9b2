/** How a file can be printed: as it was written, or live inside Klipper. */

import { computed, isAbort } from "../lib/api.js";
import { inOurWords } from "../lib/controls.js";
import { h } from "../lib/dom.js";
import { save } from "../lib/files.js";
import { bytes, duration, um } from "../lib/format.js";
import { problemPanel } from "../lib/problem.js";

const FILTER = "stillpath.json";

/**
 * @param {any} job
 * @param {any} report
 * @returns {HTMLElement | null}
 */
export function waysToPrint(job, report) {
  const ways = report.ways ?? [];
  if (report.not_live) return h("section", null, h("p", null, inOurWords(`It cannot be printed live: ${report.not_live}.`)));
  if (ways.length === 0) return null;
  const both = ways.length > 1;
  return h("section", null, h("h2", null, both ? "Two ways to print it" : "How to print it"),
    h("div.pair.ways", null, ways.map((/** @type {any} */ way) => card(job, way))),
    h("p.hint", null, both ? "Both are predictions of the same model for the same path." : "A prediction of the machine's model.",
      " “All plants” are those that explain the machine's measurement; the first figure is that of the plants in the middle."));
}

/**
 * Return a button that fetches the filter of a machine; it is designed on the first request.
 *
 * @param {string} machine
 * @returns {HTMLElement}
 */
export function filterButton(machine) {
  const fault = h("div", { "aria-live": "polite" });
  const button = h("button", { type: "button", onclick: async () => {
    if (button.getAttribute("aria-busy")) return;
    button.setAttribute("aria-busy", "true");
    fault.replaceChildren(h("p.hint", null, "The filter is being designed. The first time that takes some seconds."));
    try {
      const answer = await computed(`/v1/machines/${encodeURIComponent(machine)}/${FILTER}`);
      save(await answer.blob(), FILTER);
      fault.replaceChildren();
    } catch (error) {
      if (!isAbort(error)) fault.replaceChildren(problemPanel(error));
    } finally {
      button.removeAttribute("aria-busy");
    }
  } }, `Filter for Klipper (${FILTER})`);
  return h("div", null, button, fault);
}

/** @param {any} job @param {any} way */
function card(job, way) {
  const live = way.name === "live";
  const range = way.contour_range_um;
  const facts = [
    ["Contour error, rms", `${um(way.contour_rms_um)} µm${range ? `; all plants ${um(range[0])} to ${um(range[1])} µm` : ""}`],
    ["Largest", `${um(way.contour_max_um)} µm`],
    ["Print time", duration(way.time_s)],
    ["File to print", bytes(way.file_bytes)],
  ];
  const list = (/** @type {string[]} */ texts) => h("ul", null, texts.map((text) => h("li", null, inOurWords(text))));
  return h("div.card.way", null,
    h("h3", null, live ? "Print it live" : "Print it as a file"),
    h("p.hint", null, live ? "The file stays as sliced; an extra inside Klipper compensates the motion while it prints." : "The motion in the written file is compensated."),
    h("dl.facts", null, facts.map(([name, value]) => [h("dt", null, name), h("dd", null, value)]).flat()),
    h("h4", null, "You need"), list(way.needs),
    live ? filterButton(job.machine) : null,
    h("h4", null, "What it does not do"), list(way.lacks));
}
