/** One machine: its plants over frequency, its history, and new measurements. */

import { getJson, isAbort } from "../lib/api.js";
import { helpLink, inOurWords } from "../lib/controls.js";
import { fill, h } from "../lib/dom.js";
import { capital, number } from "../lib/format.js";
import { problemPanel } from "../lib/problem.js";
import { rememberMachine } from "../parts/machine-picker.js";
import { folded } from "../parts/table.js";
import { filterButton } from "../job/ways.js";
import { documentPanel } from "../machine/document.js";
import { measurementPanel } from "../machine/measurement.js";
import { identifiedPlots, responsePlots } from "../machine/plots.js";
import { revisionPanel } from "../machine/revisions.js";
import { SETTINGS, settingsPanel } from "../machine/settings.js";

/** @param {import("../lib/router.js").Place} place */
export async function show({ main, signal, setTitle, params: [name] }) {
  const where = `/v1/machines/${encodeURIComponent(name)}`;
  const [machine, machines] = await Promise.all([getJson(where, { signal }), getJson("/v1/machines", { signal })]);
  const summary = machines.find((/** @type {any} */ m) => m.name === machine.name) ?? { origin: "own" };
  const isOwn = summary.origin === "own";
  setTitle(machine.title);
  const plots = h("div", { "aria-busy": "true" }, h("p.hint", null, "Computing the responses …"));
  const history = h("div");
  fill(main,
    h("p.crumb", null, h("a", { href: "#/machines" }, "Machines"), " / "),
    h("div.head", null, h("h1", null, machine.title), h("span.badge", { dataset: { state: isOwn ? "own" : "builtin" } }, isOwn ? "Your own" : "Built in"),
      h("a.button.main.end", { href: "#/", onclick: () => rememberMachine(machine.name) }, "New job")),
    h("p.lead", null, h("code", null, machine.name), ` · ${machine.kinematics} · ${machine.firmware.kind}`, machine.source ? ` · ${machine.source}` : ""),
    h("section", null, h("h2", null, "Frequency response"), plots),
    isOwn ? h("section", null, h("h2", null, "Revisions"), history) : null,
    h("section", null, h("h2", null, isOwn ? "New measurement" : "Measure yours"),
      measurementPanel({ machines, base: machine.name, own: isOwn, signal })),
    isOwn && machine.firmware.kind in SETTINGS ? h("section", null, h("h2", null, "New settings"), settingsPanel({ machine: summary, firmware: machine.firmware.kind, signal })) : null,
    h("section", null, h("h2", null, "Live printing"), summary.live_refusal
      ? h("p", null, inOurWords(`It cannot print live: ${summary.live_refusal}.`))
      : [h("p", null, "The extra inside Klipper compensates with this filter while the printer prints files as sliced: ", helpLink("klipper-live", "how to install it"), "."), filterButton(machine.name)]),
    h("section", null, isOwn ? h("h2", null, "Document") : null, folded("Travel and limits", () => facts(machine)),
      documentPanel({ where, name: machine.name, revision: isOwn ? summary.revision ?? null : null, signal })));

  const draw = async (/** @type {HTMLElement} */ area, /** @type {() => Promise<Node | Node[]>} */ make) => {
    try {
      fill(area, .../** @type {Node[]} */ ([await make()].flat()));
    } catch (error) {
      if (!isAbort(error)) fill(area, problemPanel(error));
    }
    area.removeAttribute("aria-busy");
  };
  draw(plots, async () => {
    const responses = await getJson(`${where}/response`, { signal });
    const found = isOwn ? await identification(where, signal) : null;
    return [responsePlots(responses, machine, signal), ...(found ? [identifiedPlots(found, signal)] : [])];
  });
  if (isOwn) draw(history, () => revisionPanel(where, machine.name, signal));
}

/** @param {string} where @param {AbortSignal} signal */
async function identification(where, signal) {
  const { revisions } = await getJson(`${where}/revisions`, { signal });
  // What nobody measured has no identification; asking would only tell so by 404.
  const origins = Object.values(revisions.at(-1)?.provenance ?? {});
  if (origins.every((/** @type {any} */ of) => of?.kind === "typed in")) return null;
  try {
    return await getJson(`${where}/identification`, { signal });
  } catch (/** @type {any} */ error) {
    if (error?.status === 404) return null;
    throw error;
  }
}

/** @param {any} machine */
function facts(machine) {
  const travel = Object.entries(machine.travel).map(([axis, t]) => [`Travel ${axis.toUpperCase()}`, `${/** @type {any} */ (t).min_mm} to ${/** @type {any} */ (t).max_mm} mm`]);
  const planner = Object.entries(machine.firmware.planner ?? {}).filter(([, v]) => typeof v === "number")
    .map(([key, v]) => [words(key), number(/** @type {number} */ (v), 6)]);
  const command = Object.entries(machine.command ?? {}).filter(([, v]) => typeof v === "number")
    .map(([key, v]) => [`Command: ${words(key).toLowerCase()}`, number(/** @type {number} */ (v), 6)]);
  return h("dl.facts", null, [...travel, ...planner, ...command].map(([name, value]) => [h("dt", null, name), h("dd", null, value)]).flat());
}

/** @param {string} key "max_accel_mm_s2" @returns {string} */
function words(key) {
  const units = { _mm_s2: " [mm/s²]", _mm_s: " [mm/s]", _mm: " [mm]", _s: " [s]" };
  for (const [suffix, unit] of Object.entries(units)) {
    if (key.endsWith(suffix)) return words(key.slice(0, -suffix.length)) + unit;
  }
  return capital(key.replaceAll("_", " "));
}
