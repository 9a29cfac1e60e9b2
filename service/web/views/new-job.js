/** Submit a file: drop it, name the machine, send it. */

import { getJson, isAbort, upload } from "../lib/api.js";
import { announce, announcer } from "../lib/announce.js";
import { confirmed } from "../lib/dialog.js";
import { inOurWords } from "../lib/controls.js";
import { fill, h, hide } from "../lib/dom.js";
import { bytes } from "../lib/format.js";
import { METHODS } from "../lib/methods.js";
import { problemPanel } from "../lib/problem.js";
import { dropZone } from "../parts/drop-zone.js";
import { machinePicker, rememberMachine, rememberedMachine } from "../parts/machine-picker.js";

const MODELS = /\.(stl|obj|step|stp|amf|ply)$/i;
const DIALECTS = [["", "The machine's firmware"], ["klipper", "Klipper"], ["marlin", "Marlin"], ["prusa", "Prusa"], ["bambu", "Bambu"], ["reprapfirmware", "RepRapFirmware"]];

/** @param {import("../lib/router.js").Place} place */
export async function show({ main, signal, setTitle }) {
  setTitle("New job");
  const heading = [
    h("h1", null, "New job"),
    h("p.lead", null, "Submit a sliced file. You get one back that keeps the nozzle on its path, with a report of what was measured on it."),
  ];
  // As narrow as it will be with the form, so that nothing jumps when that comes.
  fill(main, h("div.narrow", null, heading));
  const [machines, printers] = await Promise.all([getJson("/v1/machines", { signal }), getJson("/v1/printers", { signal })]);
  /** @type {File | null} */
  let file = null;
  let machine = rememberedMachine();
  if (!machines.some((/** @type {any} */ m) => m.name === machine && m.problem === null)) machine = null;

  const send = h("button.main.large", { type: "submit", disabled: true }, "Compensate");
  const status = h("div", { "aria-live": "polite" });
  const ready = () => {
    send.disabled = !file || !machine;
    const refusal = machines.find((/** @type {any} */ m) => m.name === machine)?.live_refusal ?? null;
    way.refuse(refusal);
    const live = way.isLive();
    for (const part of written) hide(part, live);
    options.showFor(live);
    fill(send, live ? "Predict" : method.value === "none" ? "Measure" : "Compensate");
  };
  const way = wayToPrint(() => ready());
  const method = select("method", METHODS);
  const tolerance = h("input", { type: "number", id: "tolerance", name: "tolerance_um", min: "0.5", max: "50", step: "0.5", value: "2", required: true });
  const options = moreOptions();
  const goal = destination(printers);
  const written = [field("method", "Method", method),
    field("tolerance", "Tolerance, µm", tolerance, "How far the written path may be from the computed one.")];
  method.addEventListener("change", () => ready());
  const form = h("form.card", { onsubmit: (/** @type {Event} */ event) => {
    event.preventDefault();
    submit();
  } },
    dropZone({
      label: "Choose a G-code file, or drop it here", hint: ".gcode, .bgcode or sliced .3mf",
      onChoose: ([chosen]) => {
        file = chosen;
        ready();
        announce(`${chosen.name}, ${bytes(chosen.size)}, is chosen.`);
      },
    }),
    h("div.fields", null, machinePicker(machines, machine, (name) => {
      machine = name;
      goal.showFor(machine);
      ready();
    }), goal.element),
    way.element,
    h("div.fields.main-fields", null, written),
    options.element,
    h("div.actions", null, send),
    status);
  fill(main, h("div.narrow", null, heading, form));
  goal.showFor(machine);
  ready();

  /** @returns {string} Whether the report compares both ways: where both write or keep the motion. */
  function compares() {
    return way.isPossible() && !["none", "advise"].includes(method.value) ? "true" : "";
  }

  async function submit() {
    if (!file || !machine) return;
    const wrong = complaint(file);
    if (wrong) return fill(status, problemPanel(wrong));
    rememberMachine(machine);
    const sending = new AbortController();
    signal.addEventListener("abort", () => sending.abort());
    const bar = h("progress", { max: "1", value: "0", "aria-label": "Sent" });
    const text = h("span", null, "Sending …");
    const name = file.name;
    let isWhole = false;
    const warn = (/** @type {Event} */ event) => event.preventDefault();
    addEventListener("beforeunload", warn);
    send.disabled = true;
    const announceShare = announcer();
    fill(status, h("div.sending", { "aria-live": "off" }, bar, h("div.row", null, text,
      h("button", { type: "button", onclick: () => sending.abort() }, "Cancel"))));
    try {
      const query = way.isLive() ? { machine, method: "live", name, ...options.readFile(), ...goal.read() }
        : { machine, method: method.value, tolerance_um: tolerance.value, name, ...options.read(), ...goal.read(), compare_live: compares() };
      const job = await upload("/v1/jobs", query, file, (share) => {
        bar.value = share;
        isWhole = share === 1;
        const told = share < 1 ? `Sending: ${Math.floor(100 * share)} % of ${bytes(file?.size)}` : "Received; being stored …";
        fill(text, told);
        announceShare(share, told);
      }, sending.signal);
      location.hash = `#/jobs/${job.id}`;
    } catch (error) {
      if (signal.aborted) return notSent(name, isWhole);
      const stopped = isWhole ? "All of it had been sent: see whether it is among the jobs." : "Not sent.";
      fill(status, isAbort(error) ? h("p.hint", null, stopped) : problemPanel(error));
      ready();
      // What was pressed is gone, or was disabled meanwhile.
      if (document.activeElement === document.body) send.focus({ preventScroll: true });
    } finally {
      removeEventListener("beforeunload", warn);
    }
  }
}

/** Tell that leaving the page ended an upload. @param {string} name @param {boolean} isWhole The service may have it. */
async function notSent(name, isWhole) {
  const yes = await confirmed({ no: "Leave it", danger: false, ...(isWhole
    ? { title: "The file may have been taken", text: `You left the page while ${name} was being stored. See whether it is among the jobs.`, yes: "Show the jobs" }
    : { title: "The file was not sent", text: `You left the page while ${name} was on its way.`, yes: "Choose it again" }) });
  if (yes) location.hash = isWhole ? "#/jobs" : "#/";
}

/** What can be told of a file without sending it. @param {File} file @returns {{title: string, detail: string} | null} */
function complaint(file) {
  if (file.size === 0) return { title: "The file is empty", detail: `${file.name} has no content. Slice or copy it again.` };
  if (MODELS.test(file.name)) return { title: "The file is not sliced", detail: `${file.name} is a model. Slice it first, and submit the G-code.` };
  return null;
}

/** What few need, folded away. */
function moreOptions() {
  const basis = select("basis", [["", [["ce-opt", "CE-optimal"], ["robust", "Robust"], ["bspline", "B-splines"], ["dct", "Cosines"]]]]);
  const robust = select("robust", [["", [["auto", "Automatic"], ["off", "The nominal plant"], ["ensemble", "All of its set"], ["minimax", "The worst of its set"]]]]);
  const along = h("input", { type: "number", id: "along", min: "0.01", max: "1", step: "0.01", placeholder: "1" });
  const budget = h("input", { type: "number", id: "budget", min: "0.5", max: "1000", step: "0.5", placeholder: "keep all speeds" });
  const where = select("where", [["", [["all", "Everywhere"], ["visible", "Outer walls, top and bottom"], ["walls", "Outer walls"]]]]);
  const most = h("input", { type: "number", id: "max-mb", min: "1", step: "1", placeholder: "no limit" });
  const plate = h("input", { type: "number", id: "plate", min: "1", step: "1", placeholder: "the only one" });
  const times = select("times", [["", [["new", "Follow the new motion"], ["kept", "Stay as they are"]]]]);
  const dialect = select("dialect", [["", DIALECTS]]);
  const fresh = h("input", { type: "checkbox", id: "fresh" });
  const ofWritten = [
    field("robust", "Design for", robust),
    field("basis", "Basis functions", basis),
    field("along", "Weight along the path", along, "0.01 to 1; less takes longer."),
    field("budget", "Speed budget, µm", budget, "Contour error (rms) that every feature may have; the print becomes as fast as that allows."),
    field("where", "Compensate", where, "The rest stays as sliced, and the file is smaller."),
    field("max-mb", "Largest file, MB", most, "Compensates what is visible, then less exactly, then outer walls only, until the G-code fits."),
    field("times", "The slicer's times", times)];
  const element = h("details.more", null, h("summary", null, "More options"),
    h("div.fields", null, ofWritten,
      field("dialect", "File is written for", dialect),
      field("plate", "Plate of a 3MF package", plate)),
    h("label.check", { for: "fresh" }, fresh, "Compute again even if the same file was done before"));
  const showFor = (/** @type {boolean} */ live) => ofWritten.forEach((part) => hide(part, live));
  const readFile = () => ({ plate: plate.value, dialect: dialect.value, fresh: fresh.checked ? "true" : "" });
  const read = () => ({
    basis: basis.value, robust: robust.value, along: along.value, budget_um: budget.value, where: where.value, max_mb: most.value, plate: plate.value,
    times: times.value, dialect: dialect.value, fresh: fresh.checked ? "true" : "",
  });
  return { element, read, readFile, showFor };
}

/** Where the result goes: to a printer of the chosen machine, if the service has one. @param {any[]} printers */
function destination(printers) {
  const choice = h("select", { id: "printer" });
  const element = field("printer", "When it is done", choice);
  const offer = (/** @type {string} */ printer, /** @type {string} */ print, /** @type {string} */ words) => h("option", { value: JSON.stringify({ printer, print }) }, words);
  /** @type {string | null | undefined} */
  let shown;
  const showFor = (/** @type {string | null} */ machine) => {
    // Leaving the field of the machine names it anew: what was chosen stays.
    if (machine === shown) return;
    shown = machine;
    const fitting = printers.filter((p) => p.machine === machine);
    fill(choice, offer("", "", "It waits here to be downloaded"), ...fitting.map((p) => [
      offer(p.name, "", `Send it to ${p.name}`), p.start ? offer(p.name, "true", `Send it to ${p.name}, and print it`) : null]).flat());
    hide(element, fitting.length === 0);
  };
  return { element, showFor, read: () => JSON.parse(choice.value) };
}

/**
 * The choice between a written file and live printing.
 *
 * @param {() => void} onChange
 */
function wayToPrint(onChange) {
  /** @type {string | null} */
  let refusal = null;
  const radio = (/** @type {string} */ value, /** @type {boolean} */ checked) => h("input", { type: "radio", name: "way", id: `way-${value}`, value, checked, onchange: onChange });
  const file = radio("file", true);
  const live = radio("live", false);
  const hint = h("p.hint", { id: "way-hint" });
  live.setAttribute("aria-describedby", "way-hint");
  const element = h("fieldset.way-choice", null, h("legend", null, "How you will print"),
    h("label.check", { for: "way-file" }, file, "Print it as a file: you get a compensated file"),
    h("label.check", { for: "way-live" }, live, "Print it live: the file stays as sliced, and an extra inside Klipper compensates"), hint);
  const refuse = (/** @type {string | null} */ reason) => {
    refusal = reason;
    live.disabled = reason !== null;
    if (reason !== null) file.checked = true;
    fill(hint, reason === null ? "" : inOurWords(`It cannot be printed live: ${reason}.`));
    hint.hidden = reason === null;
  };
  return { element, refuse, isLive: () => live.checked, isPossible: () => refusal === null };
}

/**
 * @param {string} id
 * @param {any[]} groups Of [title, [value, text][]].
 */
function select(id, groups) {
  return h("select", { id }, groups.map(([title, entries]) => {
    const options = entries.map((/** @type {string[]} */ [value, text]) => h("option", { value }, text));
    return title ? h("optgroup", { label: title }, options) : options;
  }).flat());
}

/** @param {string} id @param {string} label @param {Element} control @param {string} [hint] */
function field(id, label, control, hint) {
  if (hint) control.setAttribute("aria-describedby", `${id}-hint`);
  return h("div.field", null, h("label", { for: id }, label), control, hint ? h("p.hint", { id: `${id}-hint` }, hint) : null);
}
