/** What a job does to a file, in the words of this page. */

/** Groups of [name in the API, title]. @type {[string, [string, string][]][]} */
export const METHODS = [
  ["", [["fbf", "Compensate"]]],
  ["Approximate inverses", [["zpetc", "ZPETC"], ["ebzpetc", "Extended-bandwidth ZPETC"], ["ts", "Truncated series"], ["zmetc", "ZMETC"], ["npz-ignore", "NPZ-ignore"]]],
  ["Firmware shapers", [["shaper:zv", "ZV"], ["shaper:mzv", "MZV"], ["shaper:ei", "EI"], ["shaper:2hump_ei", "2-hump EI"], ["shaper:3hump_ei", "3-hump EI"]]],
  ["", [["advise", "Advise: moves stay, firmware commands are added"], ["none", "None: measure only"]]],
];

/** @type {Record<string, string>} */
const DONE = { fbf: "compensated", advise: "advised", none: "measured only", live: "to be printed live" };

/**
 * Return what a job of a method does, for a line about it.
 *
 * @param {string | undefined} method
 * @returns {string}
 */
export function methodTitle(method = "") {
  const [, title] = METHODS.flatMap(([, methods]) => methods).find(([name]) => name === method) ?? [method, method];
  return DONE[method] ?? (method.startsWith("shaper:") ? `shaper ${title}` : title);
}
