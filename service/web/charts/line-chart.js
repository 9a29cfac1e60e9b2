/** Curves over one axis: drawn by uPlot, read by pointer, by arrow keys, or as a table. */

import uPlot from "../vendor/uplot/uPlot.esm.js";
import { fill, h } from "../lib/dom.js";
import { number } from "../lib/format.js";
import { colour, onThemeChange } from "../lib/theme.js";
import { folded, table } from "../parts/table.js";

/**
 * @typedef {object} Series
 * @property {string} label
 * @property {(number | null)[]} values
 * @property {string} colour A custom property: `--before`.
 * @property {number[]} [dash] Tells curves apart without colour.
 * @property {number} [width]
 * @property {boolean} [quiet] Neither in the legend nor in the readout nor in the table.
 * @property {boolean} [dots] Measured points, drawn one by one.
 *
 * @typedef {object} Axis
 * @property {string} label
 * @property {(value: number) => string} [text] A value with its unit.
 * @property {(value: number) => string} [tick] A value at the axis, where that is shorter.
 * @property {boolean} [log]
 * @property {boolean} [time] Ticks at whole minutes instead of tens.
 *
 * @typedef {object} Chart
 * @property {string} title
 * @property {number[]} at Positions on the x axis, rising.
 * @property {Axis} x
 * @property {Axis} y
 * @property {Series[]} series
 * @property {AbortSignal} signal
 * @property {number[]} [marks] Positions to mark by a vertical line.
 * @property {[number, number]} [range] Of y, where the data do not tell.
 */

const TABLE_ROWS = 120;
const TIME_STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400];

/**
 * @param {Chart} chart
 * @returns {HTMLElement}
 */
export function lineChart(chart) {
  const told = chart.series.filter((s) => !s.quiet);
  const xText = chart.x.text ?? ((/** @type {number} */ v) => number(v, 4));
  const yText = chart.y.text ?? ((/** @type {number} */ v) => number(v));
  const plot = h("div.plot", { tabindex: "0", role: "group", "aria-label": `${chart.title}. Left and right arrow keys read the curves.` });
  const resting = "Point at the curves, tap them, or use the arrow keys, to read them.";
  const readout = h("p.readout", { "aria-live": "polite" }, resting);
  const legend = h("ul.legend", null, told.map((s) => h("li", null, swatch(s), s.label)));
  /** @type {any} */
  let drawn = null;

  const read = (/** @type {number | null | undefined} */ k) => {
    fill(readout, k === null || k === undefined ? resting
      : `${xText(chart.at[k])}: ${told.map((s) => `${s.label} ${s.values[k] === null ? "–" : yText(/** @type {number} */ (s.values[k]))}`).join(", ")}`);
  };
  const draw = () => {
    drawn?.destroy();
    const width = plot.clientWidth;
    if (width === 0) return;
    drawn = new uPlot(settings(chart, width, xText, read), [chart.at, ...chart.series.map((s) => (chart.y.log ? positive(s.values) : s.values))], plot);
  };
  const sizes = new ResizeObserver(() => {
    if (drawn === null) draw();
    else if (drawn.width !== plot.clientWidth) drawn.setSize(sizeOf(plot.clientWidth));
  });
  sizes.observe(plot);
  onThemeChange(draw, chart.signal);
  chart.signal.addEventListener("abort", () => {
    sizes.disconnect();
    drawn?.destroy();
  });
  plot.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const last = chart.at.length - 1;
    const now = drawn?.cursor.idx ?? -1;
    const large = Math.max(1, Math.round(last / 20));
    const to = { ArrowLeft: now - 1, ArrowRight: now + 1, PageDown: now - large, PageUp: now + large, Home: 0, End: last }[event.key];
    if (to === undefined || drawn === null) return;
    event.preventDefault();
    const k = Math.min(Math.max(to, 0), last);
    drawn.setCursor({ left: drawn.valToPos(chart.at[k], "x"), top: 0 });
  });
  return h("figure.chart", null,
    h("figcaption", null, h("span.sr", null, chart.title), legend), plot, readout,
    folded("Show as a table", () => asTable(chart, told, xText, yText)));
}

/** @param {Chart} chart @param {number} width @param {(v: number) => string} xText @param {(k: number | null | undefined) => void} read */
function settings(chart, width, xText, read) {
  const ink = colour("--soft");
  const line = colour("--line");
  const axis = { stroke: ink, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif", labelSize: 18, labelGap: 0,
    grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1, size: 4 } };
  return {
    ...sizeOf(width),
    padding: [10, 14, 0, 0],
    legend: { show: false },
    cursor: { y: false, drag: { x: true, y: false }, points: { size: 7 } },
    scales: {
      x: { time: false, distr: chart.x.log ? 3 : 1 },
      y: { distr: chart.y.log ? 3 : 1, range: chart.range ?? (chart.y.log ? undefined : fromZero(chart)) },
    },
    axes: [
      { ...axis, label: chart.x.label, size: 30, space: 60, values: (/** @type {any} */ _, /** @type {any[]} */ ticks) => ticks.map((v) => (v === null ? "" : (chart.x.tick ?? xText)(v))),
        ...(chart.x.time ? { incrs: TIME_STEPS } : {}) },
      { ...axis, label: chart.y.label, size: 52, values: (/** @type {any} */ _, /** @type {any[]} */ ticks) => ticks.map((v) => (v === null ? "" : number(v, 2))),
        ...(chart.y.log ? { splits: (/** @type {any} */ _, /** @type {number} */ __, /** @type {number} */ low, /** @type {number} */ high) => powersOfTen(low, high), filter: (/** @type {any} */ _, /** @type {number[]} */ ticks) => ticks } : {}) },
    ],
    series: [{}, ...chart.series.map((s) => ({
      label: s.label, stroke: colour(s.colour), width: s.width ?? 1.6, dash: s.dash,
      points: s.dots ? { show: true, size: 4, width: 1, fill: colour(s.colour) } : { show: false },
      paths: s.dots ? () => null : undefined, spanGaps: false,
    }))],
    hooks: {
      setCursor: [(/** @type {any} */ u) => read(u.cursor.left < 0 ? null : u.cursor.idx)],
      drawClear: [(/** @type {any} */ u) => drawMarks(u, chart.marks ?? [], ink)],
    },
  };
}

/** @param {number} low @param {number} high */
function powersOfTen(low, high) {
  const first = Math.ceil(Math.log10(low) - 1e-9);
  const count = Math.max(0, Math.floor(Math.log10(high) + 1e-9) - first + 1);
  return Array.from({ length: count }, (_, k) => 10 ** (first + k));
}

/** What a logarithmic axis can show. @param {(number | null)[]} values */
function positive(values) {
  return values.map((v) => (v !== null && v > 0 ? v : null));
}

/** Smallest range that starts at zero, unless a curve goes below. @param {Chart} chart */
function fromZero(chart) {
  let low = 0;
  let high = 0;
  for (const series of chart.series) {
    for (const v of series.values) {
      if (v === null || !Number.isFinite(v)) continue;
      if (v < low) low = v;
      if (v > high) high = v;
    }
  }
  const room = 0.06 * (high - low || 1);
  return [low < 0 ? low - room : 0, high + room];
}

/** @param {any} u @param {number[]} marks @param {string} ink */
function drawMarks(u, marks, ink) {
  const pen = u.ctx;
  pen.save();
  pen.strokeStyle = ink;
  pen.lineWidth = devicePixelRatio;
  pen.setLineDash([3 * devicePixelRatio, 4 * devicePixelRatio]);
  for (const mark of marks) {
    const x = Math.round(u.valToPos(mark, "x", true)) + 0.5;
    if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) continue;
    pen.beginPath();
    pen.moveTo(x, u.bbox.top);
    pen.lineTo(x, u.bbox.top + u.bbox.height);
    pen.stroke();
  }
  pen.restore();
}

/** @param {number} width */
function sizeOf(width) {
  return { width, height: Math.round(Math.min(300, Math.max(210, width * 0.34))) };
}

/** @param {Series} series */
function swatch(series) {
  const key = h(series.dots ? "i.swatch.dot" : series.dash ? "i.swatch.dashed" : "i.swatch", { "aria-hidden": "true" });
  key.style.color = `var(${series.colour})`;
  return key;
}

/** @param {Chart} chart @param {Series[]} told @param {(v: number) => string} xText @param {(v: number) => string} yText */
function asTable(chart, told, xText, yText) {
  const step = Math.max(1, Math.ceil(chart.at.length / TABLE_ROWS));
  const rows = [];
  for (let k = 0; k < chart.at.length; k += step) {
    rows.push([xText(chart.at[k]), ...told.map((s) => (s.values[k] === null ? "–" : yText(/** @type {number} */ (s.values[k]))))]);
  }
  const note = step > 1 ? h("p.hint", null, `One of every ${step} values; ${chart.at.length} in all.`) : null;
  return h("div", null, table(chart.title, [{ title: chart.x.label }, ...told.map((s) => ({ title: `${s.label}${chart.y.label ? `, ${chart.y.label}` : ""}` }))], rows), note);
}
