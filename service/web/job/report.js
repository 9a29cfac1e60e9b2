/** What was measured on the written file, from the headline to the reverted pieces. */

import { fill, h } from "../lib/dom.js";
import { isAbort } from "../lib/api.js";
import { inOurWords } from "../lib/controls.js";
import { bytes, capital, counted, duration, grouped, um } from "../lib/format.js";
import { retryPanel, unreachable } from "../lib/problem.js";
import { folded, longTable, table } from "../parts/table.js";
import { headline } from "./headline.js";
import { spectra, trackChart } from "./curves.js";
import { trajectories } from "./trajectories.js";
import { waysToPrint } from "./ways.js";

/**
 * @param {any} job
 * @param {any} report
 * @param {AbortSignal} signal
 * @returns {Node[]}
 */
export function reportSections(job, report, signal) {
  const channels = report.channels.map((/** @type {any} */ c) => ({ ...c, short: c.label.split(" (")[0] }));
  const labels = Object.fromEntries(channels.map((/** @type {any} */ c) => [c.name, capital(c.short)]));
  return [
    headline(report, channels),
    warnings(report),
    waysToPrint(job, report),
    section("Error of the nozzle", report.notes.map((/** @type {string} */ note) => h("p", null, inOurWords(note))),
      report.confirmation ? h("p", null, `The machine's model: ${report.confirmation}.`) : null, errorTable(channels, labels),
      h("p.hint", null, "Contour: distance to the planned path. Tracking: distance to where the nozzle was planned to be at that moment.")),
    layers(job, labels, signal),
    trackChart(report, channels, labels, signal),
    spectra(report, channels, labels, signal),
    features(report, channels, labels),
    budget(report),
    advice(report),
    putBack(report, channels),
    trajectories(job, signal),
    written(report),
  ].filter((part) => part !== null);
}

/** @param {string} title @param {...any} parts */
function section(title, ...parts) {
  return h("section", null, h("h2", null, title), parts.flat());
}

/** @param {any} report */
function warnings(report) {
  if (report.warnings.length === 0) return null;
  return h("section.notice", { "aria-label": "Please read" }, h("h2", null, "Please read"),
    h("ul", null, report.warnings.map((/** @type {string} */ text) => h("li", null, inOurWords(text)))));
}

/** @param {any[]} channels @param {Record<string, string>} labels */
function errorTable(channels, labels) {
  const row = (/** @type {string} */ name, /** @type {(c: any) => number} */ value) => [name, ...channels.map((c) => um(value(c)))];
  return table("Error of the nozzle in micrometres", [{ title: "µm", text: true }, ...channels.map((c) => ({ title: key(c.name, labels[c.name]) }))], [
    row("Contour, rms, extruding", (c) => c.extruding.contour_rms_um),
    row("Contour, max, extruding", (c) => c.extruding.contour_max_um),
    row("Tracking, rms, extruding", (c) => c.extruding.tracking_rms_um),
    row("Contour, rms, all motion", (c) => c.all_motion.contour_rms_um),
    row("Contour, max, all motion", (c) => c.all_motion.contour_max_um),
    row("Vibration at rest, first 0.1 s, rms", (c) => c.residual_rms_um),
  ]);
}

/** @param {any} job @param {Record<string, string>} labels @param {AbortSignal} signal */
function layers(job, labels, signal) {
  const where = job.links.layers;
  if (!where) return null;
  const area = h("div");
  const shown = section("Layer by layer", area);
  async function load() {
    fill(area, h("p.hint", null, "Fetching the layers …"));
    area.setAttribute("aria-busy", "true");
    try {
      const { layerView } = await import("../layers/viewer.js").catch(() => {
        throw unreachable();
      });
      const view = await layerView(where, labels, signal);
      if (view === null) shown.remove();
      else fill(area, view);
    } catch (/** @type {any} */ error) {
      if (isAbort(error)) return;
      // Jobs of earlier versions have no layers.
      if (error.status === 404) shown.remove();
      else fill(area, retryPanel(error, load));
    }
    area.removeAttribute("aria-busy");
  }
  load();
  return shown;
}

/** @param {any} report @param {any[]} channels @param {Record<string, string>} labels */
function features(report, channels, labels) {
  const groups = [...report.features].sort((a, b) => b.seconds - a.seconds);
  if (groups.length === 0) return null;
  return section("By feature", longTable("Contour error by feature, root mean square", [{ title: "Contour, rms, µm", text: true },
    ...channels.map((c) => ({ title: key(c.name, labels[c.name]) })), { title: "Time", wide: true }], groups, (g) => [
    title(g), ...channels.map((c) => um(g.contour_rms_um[c.name])), duration(g.seconds)], 12));
}

/** @param {any} report */
function budget(report) {
  const found = report.budget;
  if (!found) return null;
  const compared = (/** @type {number | null} */ share) => {
    const percent = (100 * Math.abs(share ?? 0)).toFixed(1);
    return percent === "0.0" ? "the same as" : `${percent} % ${(share ?? 0) > 0 ? "less" : "more"} than`;
  };
  const shaper = found.shaper_time_s === null ? "; the best-tuned shaper cannot keep it"
    : `, and ${compared(found.saved_share_against_shaper)} with the best-tuned shaper at the same budget (${duration(found.shaper_time_s)}, predicted)`;
  return section("Speed budget",
    h("p", null, `Within a contour error of ${um(found.budget_um)} µm (rms of the worst plant of the machine's set, for every feature) the print takes ${compared(found.saved_share)} the sliced file${shaper}.`),
    longTable("Accelerations by class of moves", [{ title: "Moves", text: true }, { title: "Accelerations" }, { title: "With the shaper", wide: true }, { title: "Contour, rms of the worst plant, µm" }], found.classes, (c) => [
      title(c), `× ${c.acceleration_factor.toFixed(2)}`, `× ${c.shaper_acceleration_factor.toFixed(2)}`, um(c.contour_rms_um)], 20));
}

/** @param {any} report */
function advice(report) {
  const found = report.advice;
  if (!found) return null;
  const shapers = found.shapers.map((/** @type {any} */ s) => `${s.layer > 0 ? `from layer ${s.layer} on ` : ""}${s.label}`).join("; ");
  return section("Advice",
    h("p", null, `All moves are those of the file. ${grouped(found.lines)} lines were added; without them (they hold “; stillpath advise”) the file is as sliced.`),
    h("p", null, shapers ? `Shaper: ${shapers}.` : `The firmware's shaper stays: ${found.before_shaper}.`),
    longTable("Advice by feature", [{ title: "Feature", text: true }, { title: "Acceleration, mm/s²" }, { title: "Contour, rms of the worst plant, µm" }, { title: "Allowed, µm" }, { title: "Time", wide: true }], found.features, (f) => [
      title(f), f.accel_mm_s2 === null ? "as sliced" : `${f.exact ? "" : "≥ "}${grouped(Math.round(f.accel_mm_s2))}`, `${um(f.before_um)} → ${um(f.after_um)}`,
      f.bound_um === null ? "–" : um(f.bound_um), `${duration(f.before_s)} → ${duration(f.after_s)}`], 20));
}

/** @param {any} report @param {any[]} channels */
function putBack(report, channels) {
  if (report.advice || isLive(report) || !channels.some((c) => c.name === "after")) return null;
  const pieces = report.put_back;
  const byChoice = report.left_out_s ? h("p", null, `By choice (${report.settings.where}) ${duration(report.left_out_s)} of the print, ${duration(report.left_out_extruding_s)} of it extruding, stay as sliced.`) : null;
  const byRule = h("p", null, `By rule, ${duration(report.left_alone_s || 0)} of the print (${(100 * (report.left_alone_s || 0) / (report.time_s || 1)).toFixed(2)} %), ${duration(report.left_alone_extruding_s || 0)} of it extruding, keep the file's own lines: after homing, for example, or where a move is steep.`);
  if (report.pieces === 0) return section("Reverted to the sliced lines", h("p", null, "Nothing: no piece of the file was to be compensated."));
  if (pieces.length === 0) return section("Reverted to the sliced lines", h("p", null, `Nothing: ${report.pieces === 1 ? "the one piece was" : `all ${grouped(report.pieces)} pieces were`} verified and compensated.`), byChoice, byRule);
  return section("Reverted to the sliced lines",
    h("p", null, `${grouped(pieces.length)} of ${counted(report.pieces, "piece")}, ${(100 * report.put_back_extruding_share).toFixed(2)} % of the extruding time. They are in the file as the slicer wrote them.`),
    byChoice,
    byRule,
    longTable("Pieces reverted to the sliced lines", [{ title: "Lines", text: true }, { title: "Time" }, { title: "Extruding", wide: true }, { title: "Why", text: true }], pieces, (p) => [
      `${p.line_first}–${p.line_last}`, duration(p.seconds), duration(p.extruding_seconds), h("span", null, inOurWords(p.reason))], 20));
}

/** @param {any} report @returns {boolean} Whether no file was written, for it is to be printed live. */
function isLive(report) {
  return report.settings?.method === "live";
}

/** @param {any} report */
function written(report) {
  const compensates = !report.advice && !isLive(report);
  const facts = [
    ["Print time", `${duration(report.original_time_s)} → ${duration(report.time_s)}`],
    report.slicer_time_s ? ["By the slicer's estimate", `${duration(report.slicer_time_s)}${report.slicer ? ` (${report.slicer})` : ""}`] : null,
    ["Size", `${bytes(report.original_bytes)} → ${bytes(report.written_bytes)}`],
    !compensates ? null : ["Compensated", `${duration(report.compensated_s)} of the print; ${duration(report.extruding_s)} extrude`],
    report.segments ? ["Segments", `${grouped(report.segments)}, ${Math.round(report.segments_per_s)} per second, at most ${grouped(Math.round(report.peak_segments_per_s))}`] : null,
    !compensates ? null : ["Command", `at most ${Math.round(report.peak_velocity_mm_s)} mm/s and ${grouped(Math.round(report.peak_accel_mm_s2))} mm/s²`],
    !compensates ? null : ["Written motion against the command", `${um(report.emission_rms_um)} µm rms, ${um(report.emission_max_um)} µm max`],
    ["Best shaper of this machine", report.best_shaper],
    ["Stillpath", report.version],
  ].filter((fact) => fact !== null);
  return h("section", null, folded(isLive(report) ? "The file in figures" : "The written file in figures", () => h("dl.facts", null, facts.map(([name, value]) => [h("dt", null, name), h("dd", null, value)]).flat())));
}

/** Reports of earlier versions hold the slicer's name only. @param {any} group */
function title(group) {
  return capital(group.title || group.name) || "Not named";
}

/** @param {string} name @param {string} label */
function key(name, label) {
  return h("span.keyed", { dataset: { channel: name } }, label);
}
