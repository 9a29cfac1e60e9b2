/** Plants over frequency: modulus and phase of the model, of its set, and what was measured. */

import { inOurWords } from "../lib/controls.js";
import { h } from "../lib/dom.js";
import { interval, number } from "../lib/format.js";
import { lineChart } from "../charts/line-chart.js";
import { table } from "../parts/table.js";

const HZ = { label: "frequency, Hz", text: (/** @type {number} */ v) => `${number(v)} Hz`, tick: (/** @type {number} */ v) => number(v) };

/**
 * @param {any[]} responses Of both axes, from the service.
 * @param {any} machine Its document.
 * @param {AbortSignal} signal
 * @returns {HTMLElement}
 */
export function responsePlots(responses, machine, signal) {
  return h("div.pair", null, responses.map((axis) => h("div", null,
    h("h3", null, `${axis.axis.toUpperCase()} axis`),
    lineChart({
      title: `Frequency response of the ${axis.axis.toUpperCase()} axis, modulus`, signal, at: axis.nominal.f_hz,
      marks: axis.modes.map((/** @type {any} */ m) => m.f_hz), x: HZ, y: { label: "|G|, mm/mm" },
      series: [...members(axis.members, "magnitude", axis.nominal.f_hz.length), { label: axis.members.length ? "Nominal (thin: its set)" : "Nominal", values: axis.nominal.magnitude, colour: "--after", width: 2.2 }],
    }),
    modeTable(axis),
    h("p.hint", null, axis.band_hz ? `Measured from ${number(axis.band_hz[0])} to ${number(axis.band_hz[1])} Hz; outside, the model is a guess.` : "The machine's document names no measurement of this axis: frequencies and damping may be typed in or typical."),
    trust(machine.axes[axis.axis].provenance))));
}

/** Where the model may be far off although it fits. @param {any} provenance */
function trust(provenance) {
  if (!provenance?.trust_below_hz) return null;
  const why = provenance.kind === "spectrum" ? "the phase was not measured. A raw accelerometer log would show it." : "its phase is not certain there.";
  return h("p.hint", null, `Do not trust it above ${number(provenance.trust_below_hz)} Hz: ${why}`);
}

/**
 * @param {any} report Of an identification.
 * @param {AbortSignal} signal
 * @returns {HTMLElement}
 */
export function identifiedPlots(report, signal) {
  return h("div.identified", null, h("h3", null, "Measured and fitted"),
    h("p.hint", null, `From ${report.sources.map((/** @type {any} */ s) => s.name).join(", ")}`),
    h("div.pair", null, report.axes.map((/** @type {any} */ axis) => fitPlots(axis, signal))));
}

/**
 * What an identification found for an axis: the fit over the measurement, modes and warnings.
 *
 * @param {any} axis
 * @param {AbortSignal} signal
 * @returns {HTMLElement}
 */
export function fitPlots(axis, signal) {
  const letter = axis.axis.toUpperCase();
  return h("div", null, h("h4", null, `${letter} axis: ${axis.kind}`),
    axis.warnings.length ? h("ul.notice", null, axis.warnings.map((/** @type {string} */ w) => h("li", null, inOurWords(w)))) : null,
    axis.spectra.map((/** @type {any} */ s) => lineChart({
      title: `Measured and fitted spectrum, ${letter}: ${s.label}`, signal, at: s.f_hz, x: HZ, y: { label: "(mm/s²)²/Hz" },
      series: [{ label: "Measured", values: s.measured, colour: "--soft", width: 1.2 }, { label: "Model", values: s.predicted, colour: "--after", width: 2.2 }],
    })),
    axis.responses.flatMap((/** @type {any} */ r) => [lineChart({
      title: `Measured and fitted response, ${letter}: ${r.label}`, signal, at: r.f_hz, x: HZ, y: { label: "|G|, mm/mm" },
      series: [{ label: "Measured", values: r.magnitude, colour: "--before", dots: true }, { label: "Model", values: onto(axis.model, "magnitude", r.f_hz), colour: "--after", width: 2.2 }],
    }), lineChart({
      title: `Phase, ${letter}: ${r.label}`, signal, at: r.f_hz, x: HZ, y: { label: "phase, °" },
      series: [{ label: "Measured", values: r.phase_deg, colour: "--before", dots: true }, { label: "Model", values: onto(axis.model, "phase_deg", r.f_hz), colour: "--after", width: 2.2 }],
    })]),
    modeTable(axis),
    axis.residual === null ? null : h("p.hint", null, axis.responses.length ? `Residual of the fit: ${number(100 * axis.residual)} %` : `Residual of the fit: ${number(axis.residual)} dB rms`),
    axis.notes.map((/** @type {string} */ note) => h("p.hint", null, inOurWords(note))));
}

/** @param {any} axis With `modes`. */
function modeTable(axis) {
  if (axis.modes.length === 0) return h("p.hint", null, "No resonances.");
  const modes = table(`Modes of the ${axis.axis.toUpperCase()} axis`, [{ title: "Mode", text: true }, { title: "Frequency, Hz" }, { title: "Damping ratio" }],
    [...axis.modes].sort((/** @type {any} */ a, /** @type {any} */ b) => a.f_hz - b.f_hz).map((/** @type {any} */ m, /** @type {number} */ k) => [String(k + 1), interval(m.f_hz, m.f_sd_hz, 2), interval(m.zeta, m.zeta_sd, 4)]));
  return axis.modes.some((/** @type {any} */ m) => m.f_sd_hz) ? h("div", null, modes, h("p.hint", null, "± is 95 %, from the fit's own scatter.")) : modes;
}

/** @param {any[]} curves @param {"magnitude"} what @param {number} length */
function members(curves, what, length) {
  return curves.filter((c) => c[what].length === length)
    .map((c) => ({ label: "member", values: c[what], colour: "--member", width: 1, quiet: true }));
}

/** Values of a curve at other frequencies, linear between its own. @param {any} curve @param {string} what @param {number[]} f */
function onto(curve, what, f) {
  let k = 1;
  return f.map((at) => {
    if (at < curve.f_hz[0] || at > curve.f_hz.at(-1)) return null;
    while (k < curve.f_hz.length - 1 && curve.f_hz[k] < at) k += 1;
    const t = (at - curve.f_hz[k - 1]) / (curve.f_hz[k] - curve.f_hz[k - 1]);
    return curve[what][k - 1] + t * (curve[what][k] - curve[what][k - 1]);
  });
}
