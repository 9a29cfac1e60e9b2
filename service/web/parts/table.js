/** Tables that scroll within themselves where the screen is narrow. */

import { fill, h } from "../lib/dom.js";

/**
 * @typedef {object} Column
 * @property {any} title
 * @property {boolean} [text] Left-aligned words instead of figures.
 * @property {boolean} [wide] Left out on narrow screens.
 */

/**
 * @param {string} caption For screen readers.
 * @param {Column[]} columns The first names the row.
 * @param {any[][]} rows
 * @returns {HTMLElement}
 */
export function table(caption, columns, rows) {
  const kind = (/** @type {Column} */ c) => [c.text && "text", c.wide && "wide"].filter(Boolean).join(" ") || null;
  return h("div.scroll", { tabindex: "0", role: "region", "aria-label": caption },
    h("table", null,
      h("caption.sr", null, caption),
      h("thead", null, h("tr", null, columns.map((c) => h("th", { scope: "col", class: kind(c) }, c.title)))),
      h("tbody", null, rows.map((row) => h("tr", null, row.map((cell, k) => k === 0
        ? h("th", { scope: "row", class: kind(columns[0]) }, cell)
        : h("td", { class: kind(columns[k]) }, cell)))))));
}

/**
 * A long table, a page of rows at a time.
 *
 * @param {string} caption
 * @param {Column[]} columns
 * @param {any[]} items
 * @param {(item: any, index: number) => any[]} row
 * @param {number} [step]
 * @returns {HTMLElement}
 */
export function longTable(caption, columns, items, row, step = 50) {
  let count = Math.min(step, items.length);
  const box = h("div");
  const more = h("button", { type: "button", onclick: () => {
    const from = count;
    count = Math.min(count + 4 * step, items.length);
    draw();
    box.querySelectorAll("tbody tr")[from]?.querySelector("a, button")?.focus();
  } });
  const draw = () => {
    fill(more, `Show more of ${items.length}`);
    fill(box, table(caption, columns, items.slice(0, count).map(row)), count < items.length ? more : null);
  };
  draw();
  return box;
}

/**
 * Something folded that is only made when it is opened.
 *
 * @param {string} title
 * @param {() => Node} make
 * @returns {HTMLElement}
 */
export function folded(title, make) {
  const details = h("details", null, h("summary", null, title));
  details.addEventListener("toggle", () => {
    if (details.open && details.children.length === 1) details.append(make());
  });
  return details;
}
