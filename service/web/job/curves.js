/** Curves of a report: the error along the print, and its spectra. */

import { h } from "../lib/dom.js";
import { clock, hz, number, um } from "../lib/format.js";
import { lineChart } from "../charts/line-chart.js";

const COLOURS = { before: "--before", after: "--after", shaper: "--shaper" };
const DASHES = { before: undefined, after: undefined, shaper: [7, 4] };
const WIDTHS = { before: 1.3, after: 2.2, shaper: 1.3 };
const SPAN = 2000;

/**
 * @param {any} report
 * @param {any[]} channels
 * @param {Record<string, string>} labels
 * @param {AbortSignal} signal
 * @returns {HTMLElement | null}
 */
export function trackChart(report, channels, labels, signal) {
  const { bin_s: bin, contour_rms_um: values } = report.track;
  const count = Math.max(0, ...Object.values(values).map((v) => /** @type {any[]} */ (v).length));
  if (count < 2) return null;
  return h("section", null, h("h2", null, "Along the print"), lineChart({
    title: "Contour error along the print", signal,
    at: Array.from({ length: count }, (_, k) => k * bin),
    x: { label: `print time, ${count * bin < 3600 ? "min:s" : "h:min:s"}`, text: clock, time: true }, y: { label: "µm rms", text: (v) => `${um(v)} µm` },
    series: curves(channels, labels, values),
  }));
}

/**
 * @param {any} report
 * @param {any[]} channels
 * @param {Record<string, string>} labels
 * @param {AbortSignal} signal
 * @returns {HTMLElement | null}
 */
export function spectra(report, channels, labels, signal) {
  const axes = report.spectra ?? [];
  if (axes.length === 0) return null;
  return h("section", null, h("h2", null, "Spectra at the resonances"),
    h("p.hint", null, "How much of the error lies at which frequency. Dashed lines stand at the resonances of the machine's model."),
    h("div.pair", null, axes.map((/** @type {any} */ axis) => h("div", null,
      h("h3", null, `Along ${axis.axis.toUpperCase()}`),
      h("p.hint", null, axis.resonances_hz.length ? `Resonances at ${axis.resonances_hz.map(hz).join(", ")} Hz` : "No resonances"),
      lineChart({
        title: `Spectrum of the error along ${axis.axis.toUpperCase()}`, signal, at: axis.f_hz, marks: axis.resonances_hz,
        x: { label: "frequency, Hz", text: (v) => `${number(v)} Hz`, tick: (v) => number(v) }, y: { label: "µm/√Hz", text: (v) => `${number(v)} µm/√Hz`, log: true },
        range: decades(axis.um_per_sqrt_hz), series: curves(channels, labels, axis.um_per_sqrt_hz),
      })))));
}

/** What of a spectrum is worth seeing; resonances lie far below its peak. @param {Record<string, (number | null)[]>} values @returns {[number, number]} */
function decades(values) {
  const peak = Math.max(...Object.values(values).flat().map((v) => v ?? 0)) || 1;
  return [peak / SPAN, 1.4 * peak];
}

/** @param {any[]} channels @param {Record<string, string>} labels @param {Record<string, (number | null)[]>} values */
function curves(channels, labels, values) {
  return channels.filter((c) => values[c.name]).map((c) => {
    const name = /** @type {keyof typeof COLOURS} */ (c.name);
    return { label: labels[c.name], values: values[c.name], colour: COLOURS[name] ?? "--soft", dash: DASHES[name], width: WIDTHS[name] };
  });
}
