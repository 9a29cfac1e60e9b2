/** The layer view: slider, panes, what is under the pointer, and all layers as a table. */

import { getJson, isAbort } from "../lib/api.js";
import { fill, h } from "../lib/dom.js";
import { capital, counted, duration, um } from "../lib/format.js";
import { problemPanel } from "../lib/problem.js";
import { folded, longTable } from "../parts/table.js";
import { wireGestures } from "./gestures.js";
import { errorText, nearestPoint, nextPoint, worstPoint } from "./picking.js";
import { Stage } from "./stage.js";
import { Tiles } from "./tiles.js";

const NEAR_PX = 14;
const NARROW_PX = 640;
const RESTING = "Point at the path, or tap it, to read line, feature and error.";
const KEYS = [["← ↑ → ↓", "move"], ["+ −", "zoom"], ["0", "show all"], ["[ ]", "layer before, after"], [", .", "line before, after"]];

/**
 * @param {string} where Address of the layers: `/v1/jobs/ID/layers`.
 * @param {Record<string, string>} labels Of the channels.
 * @param {AbortSignal} signal
 * @returns {Promise<HTMLElement | null>} null if the print has no layers to show.
 */
export async function layerView(where, labels, signal) {
  const index = await getJson(where, { signal });
  if (index.layers.length === 0) return null;
  const tiles = new Tiles(where, index, signal);
  const stage = new Stage(index, labels, signal);
  /** @type {import("./tiles.js").Tile | null} */
  let tile = null;
  let shown = -1; // the layer that is drawn
  let wanted = -1; // the layer that the slider names; it may still be on its way
  let marked = -1;
  let isLoading = false;

  const last = index.layers.length - 1;
  const slider = h("input", { type: "range", id: "layer", min: "0", max: String(last), value: "0", step: "1", disabled: last === 0 });
  const name = h("output", { for: "layer" });
  const readout = h("p.readout", { "aria-live": "polite" }, RESTING);
  const fault = h("div");
  const both = ["before", "after"].filter((c) => index.channels.includes(c));
  const modes = [...(both.length === 2 ? [["both", "Side by side"]] : []), ...index.channels.map((/** @type {string} */ c) => [c, labels[c] ?? c])];
  const choice = h("div.choices", { role: "group", "aria-label": "What the view shows" }, modes.map(([mode, text]) => h("button", {
    type: "button", dataset: { mode }, onclick: () => setMode(mode) }, text)));
  let channel = both.at(-1) ?? index.channels[0];

  function setMode(/** @type {string} */ mode) {
    for (const button of choice.children) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
    if (mode !== "both") channel = mode;
    stage.setChannels(mode === "both" ? both : [mode]);
  }

  function go(/** @type {number} */ k) {
    if (k < 0 || k > last || k === wanted) return;
    wanted = k;
    slider.value = String(k);
    const layer = index.layers[k];
    const text = `${layer.name}, z ${layer.z_mm} mm`;
    fill(name, capital(layer.name), h("small", null, `z ${layer.z_mm} mm`));
    slider.setAttribute("aria-valuetext", `Layer ${layer.name}, z ${layer.z_mm} millimetres`);
    stage.element.setAttribute("aria-label", `Path of layer ${text}, coloured by contour error. Arrow keys move, plus and minus zoom, brackets change the layer, comma and full stop walk along the path.`);
    if (!isLoading) load();
  }

  /** Show the layer that is wanted; those that the slider passed meanwhile are left out. */
  async function load() {
    isLoading = true;
    stage.element.setAttribute("aria-busy", "true");
    while (shown !== wanted && !signal.aborted) {
      const k = wanted;
      try {
        tile = await tiles.get(k, k >= shown ? 1 : -1);
        shown = k;
        stage.setTile(tile);
        point(-1);
        fill(fault);
      } catch (error) {
        if (isAbort(error)) break;
        fill(fault, problemPanel(error));
        if (wanted === k) wanted = shown;
      }
    }
    stage.element.removeAttribute("aria-busy");
    isLoading = false;
  }

  function point(/** @type {number} */ k) {
    marked = k;
    stage.mark(k);
    if (tile === null || k < 0) return fill(readout, RESTING);
    const here = tile;
    const what = index.features[here.feature[k]] ?? "not named";
    const errors = index.channels.map((/** @type {string} */ c) => `${labels[c] ?? c} ${errorText(here, c, k)}`).join(", ");
    fill(readout, h("b", null, `Line ${here.line[k]}`), ` · ${what} · ${errors}`);
  }

  function walk(/** @type {number} */ step) {
    if (tile === null) return;
    const k = nextPoint(tile, marked < 0 ? (step > 0 ? 0 : tile.points) : marked, step);
    if (k <= 0 || k >= tile.points) return;
    stage.camera.reveal(tile.x[k], tile.y[k]);
    point(k);
  }

  const zoom = (/** @type {number} */ factor, /** @type {number | undefined} */ px, /** @type {number | undefined} */ py) => {
    const before = stage.camera.scale;
    if (px === undefined || py === undefined) stage.camera.zoom(factor);
    else stage.camera.zoom(factor, ...stage.inPane(px, py));
    stage.redraw();
    return stage.camera.scale !== before;
  };
  const fit = () => {
    stage.camera.fit();
    stage.redraw();
  };
  slider.addEventListener("input", () => go(Number(slider.value)));
  const tool = (/** @type {string} */ text, /** @type {string} */ label, /** @type {() => void} */ act) =>
    h("button", { type: "button", "aria-label": label, title: label, onclick: act }, text);
  const tools = h("div.zoom", { role: "group", "aria-label": "Zoom" },
    tool("+", "Zoom in", () => zoom(1.5)), tool("−", "Zoom out", () => zoom(1 / 1.5)), tool("⤢", "Show all", fit));
  const worst = h("button", { type: "button", onclick: () => {
    if (tile === null) return;
    const k = worstPoint(tile, channel);
    if (k < 0) return;
    stage.camera.reveal(tile.x[k], tile.y[k]);
    point(k);
  } }, "Worst point of this layer");
  const ticks = [0, 0.25, 0.5, 0.75, 1].map((t) => h("span", null, t === 1 ? `≥ ${index.scale_um} µm` : String(Number((t * index.scale_um).toPrecision(3)))));
  const element = h("div.layers", null,
    h("div.controls", null,
      h("label", { for: "layer" }, "Layer"),
      tool("−", "Layer below", () => go(wanted - 1)), slider, tool("+", "Layer above", () => go(wanted + 1)), name),
    h("div.row", null, choice, worst, tools),
    stage.element, readout, fault,
    h("div.legend-bar", { role: "img", "aria-label": `Colours from 0 to ${index.scale_um} micrometres of contour error` }, stage.legend, h("div.ticks", null, ticks)),
    h("p.hint.keys", null, KEYS.map(([key, what]) => h("span", null, h("kbd", null, key), ` ${what}`))),
    folded("All layers as a table", () => layerTable(index, labels, (k) => {
      go(k);
      // The table is far below the picture; the focus alone would bring the slider half-way up.
      slider.focus({ preventScroll: true });
      for (const part of [slider, stage.element]) part.scrollIntoView({ block: "nearest" });
    })));

  wireGestures(stage.element, {
    zoom, fit, walk,
    pan: (dx, dy) => {
      stage.camera.pan(dx, dy);
      stage.redraw();
    },
    point: (px, py) => {
      if (tile === null) return;
      const k = nearestPoint(tile, ...stage.camera.toWorld(...stage.inPane(px, py)), NEAR_PX / stage.camera.scale);
      if (k !== marked) point(k);
    },
    leave: () => point(-1),
    layer: (step) => go(wanted + step),
    isFitted: () => stage.camera.isFitted,
  });
  await stage.start();
  setMode(both.length === 2 && innerWidth >= NARROW_PX ? "both" : channel);
  go(Math.floor(last / 2));
  return element;
}

/** @param {any} index @param {Record<string, string>} labels @param {(k: number) => void} go */
function layerTable(index, labels, go) {
  const columns = [{ title: "Layer", text: true }, { title: "z, mm" }, { title: "Time", wide: true },
    ...index.channels.flatMap((/** @type {string} */ c) => [{ title: `${labels[c] ?? c}, rms µm` }, { title: "max µm", wide: true }])];
  const box = longTable(`Contour error of ${counted(index.layers.length, "layer")}`, columns, index.layers, (layer, k) => [
    h("button.link", { type: "button", onclick: () => go(k) }, layer.name), String(layer.z_mm), duration(layer.seconds),
    ...index.channels.flatMap((/** @type {string} */ c) => [um(layer.rms_um?.[c]), um(layer.max_um?.[c])]),
  ]);
  return box;
}
