/** The field for the name of a new machine. */

import { h } from "../lib/dom.js";

/** What machines may be called, as `applications/machines/store.py` has it. */
const NAME = { pattern: "[a-z0-9][a-z0-9_\\-]{0,63}", maxlength: "64" };

/**
 * @param {string} id
 * @param {any[]} machines Those that are there: another one must not be changed by mistake.
 * @returns {{input: HTMLInputElement, field: HTMLElement}}
 */
export function nameField(id, machines) {
  const input = h("input", { type: "text", id, required: true, ...NAME, autocomplete: "off", spellcheck: "false", "aria-describedby": `${id}-hint`, oninput: () => {
    const taken = machines.find((m) => m.name === input.value);
    input.setCustomValidity(!taken ? "" : taken.origin === "own"
      ? `You have a machine ${taken.name} already. Take another name, or open that machine to change it.`
      : `${taken.name} is built in. Take another name.`);
  } });
  const field = h("div.field", null, h("label", { for: id }, "Name of your machine"), input, h("p.hint", { id: `${id}-hint` }, "Small letters, digits, - and _."));
  return { input, field };
}
