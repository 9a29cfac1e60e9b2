/** Figures and moments as a person reads them. */

const THIN = "\u202f";

/**
 * Micrometres with three significant digits at most.
 *
 * @param {number | null | undefined} value
 * @returns {string}
 */
export function um(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  return value >= 99.95 ? grouped(Math.round(value)) : value.toFixed(value >= 9.995 ? 1 : 2);
}

/**
 * @param {number} value
 * @param {[number, number] | null} [range] Where it may lie instead, if that is known.
 * @returns {string} "0.92 to 11.0"
 */
export function umOrRange(value, range) {
  return range ? `${um(range[0])} to ${um(range[1])}` : um(value);
}

/**
 * A value with its 95 % interval, with as many decimals as that needs.
 *
 * @param {number} value
 * @param {number | null | undefined} deviation Standard deviation.
 * @param {number} decimals At least.
 * @returns {string} "34.66 ± 0.07"
 */
export function interval(value, deviation, decimals) {
  if (!deviation) return value.toFixed(decimals);
  const half = 1.96 * deviation;
  const shown = Math.min(Math.max(decimals, -Math.floor(Math.log10(half))), decimals + 2);
  return `${value.toFixed(shown)} ± ${half.toFixed(shown)}`;
}

/**
 * @param {string} text
 * @returns {string} Beginning with a capital.
 */
export function capital(text) {
  return text ? text[0].toUpperCase() + text.slice(1) : "";
}

/**
 * @param {number} value
 * @returns {string} With a thin space between thousands.
 */
export function grouped(value) {
  return String(value).replace(/\B(?=(\d{3})+$)/g, THIN);
}

/**
 * @param {number | null | undefined} value
 * @param {number} [digits] Significant ones.
 * @returns {string}
 */
export function number(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value !== 0 && (Math.abs(value) >= 1e5 || Math.abs(value) < 1e-5)) {
    return value.toExponential(digits - 1).replace("e+", "e");
  }
  return String(Number(value.toPrecision(Math.max(digits, Math.ceil(Math.log10(Math.abs(value) + 1))))));
}

/**
 * @param {number} value
 * @returns {string} A frequency in hertz, with one decimal, so that those in a column line up.
 */
export function hz(value) {
  return value.toFixed(1);
}

/**
 * @param {number | null | undefined} seconds
 * @returns {string} "12.3 s", "4 min 05 s", "2 h 03 min"
 */
export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "–";
  if (seconds < 59.95) return `${seconds.toFixed(seconds >= 9.995 ? 1 : 2)} s`;
  const whole = Math.round(seconds);
  const hours = Math.floor(whole / 3600);
  const minutes = Math.floor(whole / 60) % 60;
  return hours ? `${hours} h ${two(minutes)} min` : `${minutes} min ${two(whole % 60)} s`;
}

/**
 * Time still needed, coarse: a figure that jumps about helps nobody.
 *
 * @param {number | null | undefined} seconds
 * @returns {string}
 */
export function remaining(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 1) return "a moment left";
  if (seconds < 10) return `${Math.ceil(seconds)} s left`;
  if (seconds < 90) return `${5 * Math.ceil(seconds / 5)} s left`;
  return `${Math.ceil(seconds / 60)} min left`;
}

/**
 * @param {number} seconds
 * @returns {string} "1:02:03" or "2:03"
 */
export function clock(seconds) {
  const hours = Math.floor(seconds / 3600);
  const minutes = Math.floor(seconds / 60) % 60;
  const rest = two(Math.floor(seconds % 60));
  return hours ? `${hours}:${two(minutes)}:${rest}` : `${minutes}:${rest}`;
}

/**
 * @param {number | null | undefined} size
 * @returns {string}
 */
export function bytes(size) {
  if (size === null || size === undefined) return "–";
  if (size < 1000) return `${size} B`;
  if (size < 1e6) return `${(size / 1e3).toFixed(1)} kB`;
  return size < 1e9 ? `${(size / 1e6).toFixed(1)} MB` : `${(size / 1e9).toFixed(2)} GB`;
}

/**
 * @param {string | null | undefined} moment ISO 8601.
 * @returns {string} In the reader's zone.
 */
export function when(moment) {
  if (!moment) return "–";
  return new Date(moment).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
}

/**
 * @param {number} count
 * @param {string} one
 * @param {string} [many]
 * @returns {string}
 */
export function counted(count, one, many = `${one}s`) {
  return `${grouped(count)} ${count === 1 ? one : many}`;
}

/** @param {number} value */
function two(value) {
  return String(value).padStart(2, "0");
}
