/** Upload measurements, look at the fit, and keep it as a revision. */

import { address, computed, isAbort } from "../lib/api.js";
import { announce } from "../lib/announce.js";
import { fill, h } from "../lib/dom.js";
import { counted } from "../lib/format.js";
import { problemPanel } from "../lib/problem.js";
import { dropZone } from "../parts/drop-zone.js";
import { nameField } from "./name.js";
import { fitPlots } from "./plots.js";

const TEST = [
  ["min_freq", "From, Hz", "5"], ["max_freq", "To, Hz", "135 (133.3)"], ["hz_per_sec", "Hz per second", "1"],
  ["accel_per_hz", "Acceleration per Hz, mm/s", "60 (75)"], ["sweeping_accel", "Sweeping acceleration, mm/s²", "400 (0)"],
];
const FACTS = [
  ["sensor_turned", "The sensor was mounted differently for X and for Y"],
  ["frame_firm", "The frame does not move (bolted down, heavy): what the sensor felt is what prints"],
];

/**
 * @param {{machines: any[], base: string | null, own?: boolean, signal: AbortSignal}} about `base`:
 *   the machine that is measured (`own`), or that a new one starts from.
 * @returns {HTMLElement}
 */
export function measurementPanel({ machines, base, own = false, signal }) {
  /** @type {File[]} */
  let files = [];
  const result = h("div", { "aria-live": "polite" });
  const look = h("button.main", { type: "submit", disabled: true }, "Look at the fit");
  const name = nameField("new-name", machines);
  const start = h("select", { id: "base", required: true }, h("option", { value: "" }, "Choose the most similar"), machines.filter((m) => m.problem === null).map((m) => h("option", { value: m.name, selected: m.name === base }, m.title)));
  const author = h("input", { type: "text", id: "measured-by", maxlength: "100", autocomplete: "name" });
  const test = testOptions();
  const form = h("form.card", { onsubmit: (/** @type {Event} */ event) => {
    event.preventDefault();
    send(chosen(), true);
  } },
    dropZone({ label: "Choose measurements, or drop them here", hint: "Klipper's raw_data_*.csv or resonances_*.csv, Shake&Tune's .stdata, a ring test with its logs, frequency responses, recordings; several at once", multiple: true,
      onChoose: (chosen) => {
        files = chosen;
        look.disabled = false;
        fill(result);
      } }),
    h("div.fields", null,
      own ? null : name.field,
      own || base !== null ? null : h("div.field", null, h("label", { for: "base" }, "Travel and limits from"), start),
      h("div.field", null, h("label", { for: "measured-by" }, "Your name"), author)),
    test.element,
    h("div.actions", null, look), result);

  /** What is asked for now; the fit that is looked at is kept as it was asked for. */
  function chosen() {
    const target = own ? /** @type {string} */ (base) : name.input.value;
    return { target, files: [...files], options: { base: own ? "" : base ?? start.value, ...test.read() } };
  }

  /** @param {ReturnType<typeof chosen>} asked @param {boolean} trial */
  async function send(asked, trial) {
    const { target, options } = asked;
    const body = new FormData();
    for (const file of asked.files) body.append("file", file, file.name);
    look.disabled = true;
    const said = h("span", null, "Identifying; this takes some ten seconds …");
    // The same text anew would be spoken anew, every second.
    const tell = (/** @type {string} */ text) => said.textContent === text || fill(said, text);
    fill(result, h("p.row", null, h("progress", { "aria-label": "Identifying" }), said));
    try {
      const path = address(`/v1/machines/${encodeURIComponent(target)}/measurements`, {
        trial: trial ? "true" : "", author: author.value.trim(), ...options });
      const found = await (await computed(path, { method: "POST", body, signal }, (job) => tell(`Identifying: ${job.stage} …`))).json();
      if (!trial) {
        announce(`Revision ${found.revision.number} of ${target} is kept.`);
        const here = `#/machines/${encodeURIComponent(target)}`;
        if (location.hash === here) dispatchEvent(new HashChangeEvent("hashchange"));
        else location.hash = here;
        return;
      }
      const keep = h("button.main", { type: "button", onclick: () => send(asked, false) }, own ? "Keep as the next revision" : `Keep as ${target}`);
      fill(result, h("h3", { tabindex: "-1" }, "The fit"), h("p.hint", null, `${counted(asked.files.length, "file")}. Nothing is stored yet.`),
        h("div.pair", null, found.report.axes.map((/** @type {any} */ axis) => fitPlots(axis, signal))),
        h("div.actions", null, keep));
      result.querySelector("h3")?.focus();
    } catch (error) {
      if (!isAbort(error)) fill(result, problemPanel(error));
    }
    look.disabled = false;
  }

  return form;
}

/** How the test was run, where it was not Klipper's default; folded away. */
function testOptions() {
  const inputs = TEST.map(([name, , hint]) => h("input", { type: "number", id: `test-${name}`, min: "0", step: "any", placeholder: hint }));
  const boxes = FACTS.map(([name]) => h("input", { type: "checkbox", id: `test-${name}` }));
  const chooser = (/** @type {string} */ id, /** @type {string[][]} */ choices) =>
    h("select", { id }, choices.map(([value, text]) => h("option", { value }, text)));
  const axis = chooser("test-axis", [["", "As the files say"], ["x", "X"], ["y", "Y"]]);
  const guides = chooser("test-guides", [["", "Usual for its kinematics"], ["wheels", "Wheels or bushings"], ["rails", "Rails"]]);
  const element = h("details", null, h("summary", null, "How the test was run"),
    h("p.hint", null, "Empty: as the file says, else Klipper's default as shown; in brackets that of Klipper before 2024-12. Of a table of resonances only what lies between From and To is fitted."),
    h("div.fields", null,
      h("div.field", null, h("label", { for: "test-axis" }, "Axis"), axis),
      h("div.field", null, h("label", { for: "test-guides" }, "Guides"), guides),
      TEST.map(([name, label], k) => h("div.field", null, h("label", { for: `test-${name}` }, label), inputs[k]))),
    FACTS.map(([name, label], k) => h("label.check", { for: `test-${name}` }, boxes[k], label)));
  const read = () => ({ axis: axis.value, guides: guides.value,
    ...Object.fromEntries(TEST.map(([name], k) => [name, inputs[k].value])),
    ...Object.fromEntries(FACTS.map(([name], k) => [name, boxes[k].checked ? "true" : ""])) });
  return { element, read };
}
