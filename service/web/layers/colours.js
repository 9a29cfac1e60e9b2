/**
 * The colours of errors: matplotlib's "viridis" (CC0), even steps of lightness that are read without
 * colour vision. Small errors recede towards the ground, whichever ground it is.
 */

const VIRIDIS = ["#440154", "#481b6d", "#46327e", "#3f4788", "#365c8d", "#2e6e8e", "#277f8e",
  "#21918c", "#1fa187", "#2db27d", "#4ac16d", "#73d056", "#a0da39", "#d0e11c", "#fde725"];

/** Steps of a colour map. */
export const STEPS = 256;
/** What is drawn where the error is not known. */
export const UNKNOWN = [140, 140, 140];

/**
 * @param {boolean} isDark The ground.
 * @returns {Uint8Array} STEPS colours as RGBA, from no error to the top of the scale.
 */
export function colourMap(isDark) {
  const map = new Uint8Array(4 * STEPS);
  for (let k = 0; k < STEPS; k += 1) {
    const t = k / (STEPS - 1);
    const [r, g, b] = viridis(isDark ? 0.24 + 0.76 * t : 0.8 - 0.8 * t);
    map.set([r, g, b, 255], 4 * k);
  }
  return map;
}

/**
 * Draw the map from left to right.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {Uint8Array} map
 */
export function drawLegend(canvas, map) {
  canvas.width = STEPS;
  canvas.height = 1;
  const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  pen.putImageData(new ImageData(new Uint8ClampedArray(map), STEPS, 1), 0, 0);
}

/** @param {number} t @returns {number[]} */
function viridis(t) {
  const at = t * (VIRIDIS.length - 1);
  const k = Math.min(Math.floor(at), VIRIDIS.length - 2);
  const [a, b] = [parse(VIRIDIS[k]), parse(VIRIDIS[k + 1])];
  return a.map((v, c) => Math.round(v + (b[c] - v) * (at - k)));
}

/** @param {string} hex */
function parse(hex) {
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
}
