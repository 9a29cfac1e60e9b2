/** What the service calls an option, in the words of this page: its texts are for the command line and programs too. */

const PLACES = { all: "Everywhere", visible: "Outer walls, top and bottom", walls: "Outer walls" };

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
 * Return a text of the service with the names of this page's controls.
 *
 * @param {string} text
 * @returns {string}
 */
export function namingControls(text) {
  return OPTIONS.reduce((said, [option, control]) => said.replace(option, control), text);
}
