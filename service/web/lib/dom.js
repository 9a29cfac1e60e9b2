/** Making elements. Text always goes in as text, never as HTML. */

/** @typedef {Node | string | number | null | undefined | false} Child */

/**
 * Make an element.
 *
 * @param {string} what Tag with classes: `"p.hint"`.
 * @param {Record<string, any> | null} [props] `on...` are listeners, `dataset` an object; other
 *   names are attributes (true: empty, false or null: left out).
 * @param {...(Child | Child[])} children
 * @returns {any}
 */
export function h(what, props, ...children) {
  const [tag, ...classes] = what.split(".");
  const element = document.createElement(tag || "div");
  if (classes.length) element.className = classes.join(" ");
  for (const [name, value] of Object.entries(props ?? {})) set(element, name, value);
  element.append(...children.flat().filter(isShown).map(asNode));
  return element;
}

/**
 * Replace what an element holds.
 *
 * @param {Element} element
 * @param {...(Child | Child[])} children
 */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat().filter(isShown).map(asNode));
}

/**
 * Hide or show a part of a form. What is hidden is disabled too: the browser would refuse to send
 * the form for a wrong value that nobody sees.
 *
 * @param {HTMLElement} part
 * @param {boolean} isHidden
 */
export function hide(part, isHidden) {
  part.hidden = isHidden;
  for (const control of part.querySelectorAll("input, select")) /** @type {HTMLInputElement} */ (control).disabled = isHidden;
}

/**
 * Put the focus where reading starts.
 *
 * @param {HTMLElement} main
 */
export function focusHeading(main) {
  const heading = main.querySelector("h1");
  if (heading === null) return main.focus();
  heading.setAttribute("tabindex", "-1");
  heading.focus({ preventScroll: true });
}

/**
 * Do something that may replace the element with the focus, which then goes where reading starts.
 *
 * @param {Element} area
 * @param {() => void} replace
 */
export function keepingFocus(area, replace) {
  const held = area.contains(document.activeElement);
  replace();
  const main = document.querySelector("main");
  if (held && document.activeElement === document.body && main !== null) focusHeading(main);
}

/**
 * Return the ids that tie a label to its field.
 *
 * @param {string} stem
 * @returns {string}
 */
export function uniqueId(stem) {
  counter += 1;
  return `${stem}-${counter}`;
}

let counter = 0;

/** @param {Element} element @param {string} name @param {any} value */
function set(element, name, value) {
  if (value === null || value === undefined || value === false) return;
  if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
  else if (name === "dataset") Object.assign(/** @type {HTMLElement} */ (element).dataset, value);
  else element.setAttribute(name, value === true ? "" : String(value));
}

/** @param {Child} child */
function isShown(child) {
  return child !== null && child !== undefined && child !== false;
}

/** @param {any} child */
function asNode(child) {
  return child instanceof Node ? child : document.createTextNode(String(child));
}
