/** A machine of what its printer says of itself: printer.cfg, config.g, or Marlin's answer to M503. */

import { isAbort, request } from "../lib/api.js";
import { announce } from "../lib/announce.js";
import { fill, h, hide } from "../lib/dom.js";
import { problemPanel } from "../lib/problem.js";
import { dropZone } from "../parts/drop-zone.js";
import { nameField } from "./name.js";

const ENDS = "\\s*(-?[0-9.]+\\s*:\\s*)?[0-9.]+\\s*";
const TRAVEL = `${ENDS}[xX]${ENDS}[xX]${ENDS}`;
/** As `service/api/machine_settings.py` has it. */
const LARGEST_BYTES = 4e6;
const M503 = /^.*\bM(92|201|203|204|205)\s+[A-Z]/m;
const CONFIG_G = /^[ \t]*(M98[ \t]*P|M563\b|M566\b|M584\b|M669\b)/im;

/** What the printers of a firmware say of themselves. @type {Record<string, string>} */
export const SETTINGS = { klipper: "printer.cfg", reprapfirmware: "config.g", marlin: "Marlin's answer to M503" };

/**
 * @param {{machine: {name: string, revision: string} | null, machines?: any[], firmware?: string, signal: AbortSignal}} about
 *   `machine`: the one that gets the values, with its firmware, or null for one that is new among `machines`.
 * @returns {HTMLElement}
 */
export function settingsPanel({ machine, machines = [], firmware = "", signal }) {
  let text = "";
  let file = "";
  const status = h("div", { "aria-live": "polite" });
  const keep = h("button.main", { type: "submit", disabled: true }, machine ? "Keep the settings as the next revision" : "Make the machine");
  const name = nameField("settings-name", machines);
  const travel = h("input", { type: "text", id: "travel", pattern: TRAVEL, placeholder: "235x235x250", "aria-describedby": "travel-hint" });
  const kinematics = h("select", { id: "kinematics" }, [["cartesian", "Cartesian"], ["corexy", "CoreXY"]].map(([value, words]) => h("option", { value }, words)));
  const [fx, fy] = ["x", "y"].map((axis) => h("input", { type: "number", id: `f${axis}`, min: "1", max: "500", step: "any", placeholder: "as the file says" }));
  const marlin = h("div", { hidden: true },
    h("div.fields", null,
      field("travel", "How far X, Y and Z reach, mm", travel, "M503 does not say it. Where an axis begins below 0, as start codes may want it: -4:220x-17:227x250."),
      field("kinematics", "Kinematics", kinematics)),
    h("p.hint", null, "What else M503 does not say (version, MIN_STEPS_PER_SEGMENT, S-curves) is taken as most builds have it. Look it up in Configuration.h, and change it in the machine's document if yours differs."));
  return h("form.card", { onsubmit: (/** @type {Event} */ event) => {
    event.preventDefault();
    send();
  } },
    dropZone(machine
      ? { label: `Choose ${SETTINGS[firmware]}, or drop it here`, hint: "What it does not say stays as it is, and so does what was measured", onChoose }
      : { label: "Choose printer.cfg, config.g or Marlin's answer to M503, or drop it here", hint: "Klipper: printer.cfg. RepRapFirmware: config.g of the folder sys. Marlin: send M503 from a host, and save all of the answer as a text file", onChoose }),
    machine ? null : [
      h("div.fields", null,
        name.field,
        field("fx", "Resonance of X, Hz", fx, "If you know it. A measurement replaces it."),
        field("fy", "Resonance of Y, Hz", fy)),
      marlin],
    h("div.actions", null, keep), status);

  /** @param {File[]} files */
  async function onChoose([chosen]) {
    keep.disabled = true;
    if (chosen.size > LARGEST_BYTES) {
      fill(status, problemPanel({ title: "Not a printer's settings", detail: `${chosen.name} is larger than 4 MB, which no printer's settings are. Choose another file; for measurements there is another field on this page.` }));
      return;
    }
    text = await chosen.text();
    file = chosen.name;
    hide(marlin, CONFIG_G.test(text) || !M503.test(text));
    travel.required = !machine && !marlin.hidden;
    keep.disabled = false;
    fill(status);
  }

  async function send() {
    const target = machine ? machine.name : name.input.value;
    keep.disabled = true;
    try {
      const query = machine || marlin.hidden
        ? { file, fx: fx.value, fy: fy.value }
        : { file, fx: fx.value, fy: fy.value, travel: travel.value.trim(), kinematics: kinematics.value };
      const headers = { "Content-Type": "text/plain", ...(machine ? { "If-Match": `"${machine.revision}"` } : {}) };
      const made = await (await request(`/v1/machines/${encodeURIComponent(target)}/settings`, { method: "POST", query, headers, body: text, signal })).json();
      announce(`Revision ${made.number} of ${target} is kept.`);
      const here = `#/machines/${encodeURIComponent(target)}`;
      if (location.hash === here) dispatchEvent(new HashChangeEvent("hashchange"));
      else location.hash = here;
    } catch (error) {
      if (!isAbort(error)) fill(status, problemPanel(error));
      keep.disabled = false;
    }
  }
}

/** @param {string} id @param {string} label @param {Element} control @param {string} [hint] */
function field(id, label, control, hint) {
  return h("div.field", null, h("label", { for: id }, label), control, hint ? h("p.hint", { id: `${id}-hint` }, hint) : null);
}
