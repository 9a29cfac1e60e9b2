/** The three figures that tell a job. */

import { h } from "../lib/dom.js";
import { duration, um, umOrRange } from "../lib/format.js";

// Measuring a file that came as it was is no improvement, whatever the last digit says.
const LEAST_RATIO = 1.05;

/**
 * @param {any} report
 * @param {any[]} channels
 * @returns {HTMLElement}
 */
export function headline(report, channels) {
  // A file that extrudes nothing, such as a coupon drawn with a pen, is judged by all its motion.
  const extrudes = channels.some((c) => c.extruding.contour_max_um > 0);
  const rms = Object.fromEntries(channels.map((c) => [c.name, (extrudes ? c.extruding : c.all_motion).contour_rms_um]));
  const selected = channels.filter((c) => Number.isFinite(c.selected_rms_um));
  for (const c of selected) rms[c.name] = c.selected_rms_um;
  const ranges = extrudes ? Object.fromEntries(channels.map((c) => [c.name, c.contour_range_um])) : {};
  const said = (/** @type {string} */ name) => umOrRange(rms[name], ranges[name]);
  const chosen = report.settings?.where === "walls" ? "of outer walls" : "of visible surfaces";
  const label = `Contour error ${extrudes ? (selected.length ? chosen : "while extruding") : "of all motion (nothing is extruded)"}, rms`;
  const rubbing = extrudes ? Object.fromEntries(channels.map((c) => [c.name, c.contour_rubbing_um])) : {};
  const ifGuidesRub = rubbing.after ? `. If guides rub, which was not measured: up to ${um(rubbing.after)}${rubbing.before ? ` (${um(rubbing.before)} as sliced)` : ""}` : "";
  const ratio = rms.before / rms.after;
  const change = 100 * (report.time_s / report.original_time_s - 1);
  return h("section.headline", { "aria-label": "Headline" },
    rms.after !== undefined
      ? h("div.figure.first", null, h("p.label", null, label),
        h("p.big", null, h("span.before", null, um(rms.before)), h("span.to", { "aria-hidden": "true" }, " → "), h("span.sr", null, " to "), h("span.after", null, said("after")), h("small", null, "\u00a0µm")),
        h("p.note", null, ranges.after ? `predicted, by all plants that explain what is known of the machine; ${um(rms.after)} by the one in the middle${ifGuidesRub}` : ratio >= LEAST_RATIO ? `${ratio >= 10 ? ratio.toFixed(0) : ratio.toFixed(1)} times smaller than as sliced` : "no smaller than as sliced"))
      : h("div.figure.first", null, h("p.label", null, label),
        h("p.big", null, h("span.before", null, um(rms.before)), h("small", null, "\u00a0µm")), h("p.note", null, "as sliced")),
    rms.shaper === undefined ? null
      : h("div.figure", null, h("p.label", null, "Best-tuned shaper"), h("p.big", null, said("shaper"), h("small", null, "\u00a0µm")), h("p.note", null, `${report.best_shaper}${rubbing.shaper ? `; up to ${um(rubbing.shaper)} if guides rub` : ""}`)),
    h("div.figure", null, h("p.label", null, "Print time"), h("p.big", null, duration(report.time_s)),
      h("p.note", null, rms.after === undefined || report.settings?.method === "live" || !Number.isFinite(change) ? "by the firmware's rules" : `${change >= 0 ? "+" : "−"}${Math.abs(change).toFixed(2)} % against the original`)));
}
