/** Texts of the service in the words of this page: they are for the command line and programs too. */

import { h } from "./dom.js";

const PLACES = { all: "Everywhere", visible: "Outer walls, top and bottom", walls: "Outer walls" };

const DOCUMENT = /\bdocs\/([\w/-]+)\.md\b/;
/** @type {[RegExp, (found: string, value: string) => string][]} */
const OPTIONS = [
  [/\bmethod advise/g, () => "the method “Advise”"],
  [/\(dialect \w+\)/g, () => "(“File is written for”)"],
  [/\(option plate\)/g, () => "(“Plate of a 3MF package”)"],
  [/\bmax_mb=([\d.e+]+)/g, (_, value) => `“Largest file” ${value} MB`],
  [/\btolerance_um=([\d.]+)/g, (_, value) => `“Tolerance” ${value} µm`],
  [/\bwhere=(all|visible|walls)/g, (_, value) => `“Compensate: ${PLACES[/** @type {"all"} */ (value)]}”`],
];

/**
 * Return a text of the service with the names of this page's controls, and links to documents.
 *
 * @param {string} text
 * @returns {(string | Node)[]}
 */
export function inOurWords(text) {
  const said = OPTIONS.reduce((before, [option, control]) => before.replace(option, control), text);
  const [first, ...parts] = said.split(DOCUMENT);
  return [first, ...parts.map((part, k) => k % 2 === 0 ? helpLink(part, `docs/${part}.md`) : part)];
}

/**
 * Return a link to the documentation; in a tab of its own, for this one may hold what was entered.
 *
 * @param {string} name Of a page, with an anchor at will: `"safety#marlin"`.
 * @param {string} text
 * @returns {HTMLElement}
 */
export function helpLink(name, text) {
  return h("a", { href: `help/${name}`, target: "_blank", rel: "noopener" }, text, h("span.sr", null, " (new tab)"));
}
