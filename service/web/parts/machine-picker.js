/** A field to choose a machine by typing a part of its name (ARIA combobox with a listbox). */

import { announce } from "../lib/announce.js";
import { fill, h } from "../lib/dom.js";
import { counted } from "../lib/format.js";

const LAST_MACHINE = "stillpath.machine";

/**
 * @typedef {{name: string, title: string, origin: string, kinematics: string,
 *   problem: string | null}} Machine
 */

/**
 * @param {Machine[]} machines
 * @param {string | null} chosen Name of the machine that is chosen at first.
 * @param {(name: string | null) => void} onChoose
 * @returns {HTMLElement}
 */
export function machinePicker(machines, chosen, onChoose) {
  const isOwn = (/** @type {Machine} */ m) => m.origin === "own";
  const usable = machines.filter((m) => m.problem === null).sort((a, b) => Number(isOwn(b)) - Number(isOwn(a)));
  const list = h("ul.options", {
    role: "listbox", id: "machine-options", "aria-label": "Machines", hidden: true,
    // The field keeps the focus. Not `onpointerdown`: a finger may mean to scroll.
    onmousedown: (/** @type {Event} */ event) => event.preventDefault(),
  });
  const input = h("input", {
    type: "text", id: "machine", role: "combobox", autocomplete: "off", spellcheck: "false",
    placeholder: "Type to search", "aria-autocomplete": "list", "aria-expanded": "false",
    "aria-controls": "machine-options", "aria-describedby": "machine-hint",
  });
  const hint = h("p.hint", { id: "machine-hint" });
  /** @type {Machine[]} */
  let shown = [];
  let active = -1;
  let current = usable.find((m) => m.name === chosen) ?? null;

  const tell = () => fill(hint, current
    ? `${current.name} · ${current.kinematics} · ${current.origin}`
    : "A compensated file fits one machine only: choose the one that will print it.");
  const open = (/** @type {boolean} */ isOpen) => {
    list.hidden = !isOpen;
    input.setAttribute("aria-expanded", String(isOpen));
    if (!isOpen) input.removeAttribute("aria-activedescendant");
  };
  const draw = () => {
    fill(list, shown.map((m, k) => h("li", {
      role: "option", id: `machine-option-${k}`, "aria-selected": String(k === active),
      onclick: () => choose(m),
    }, h("span", null, m.title), h("small", null, `${m.name} · ${m.origin}`))),
    shown.length ? null : h("li.none", { role: "option", "aria-selected": "false", "aria-disabled": "true" }, "No machine has this in its name."));
    if (active >= 0 && shown.length) {
      input.setAttribute("aria-activedescendant", `machine-option-${active}`);
      list.children[active].scrollIntoView({ block: "nearest" });
    } else input.removeAttribute("aria-activedescendant");
  };
  const fitting = (/** @type {string} */ text) => {
    const words = text.toLowerCase().split(/\s+/).filter(Boolean);
    return usable.filter((m) => words.every((w) => `${m.title} ${m.name}`.toLowerCase().includes(w)));
  };
  const search = (/** @type {string} */ text) => {
    shown = fitting(text);
    active = shown.length && text ? 0 : shown.findIndex((m) => m === current);
    draw();
    open(true);
  };
  const choose = (/** @type {Machine | null} */ machine) => {
    current = machine;
    input.value = machine?.title ?? "";
    open(false);
    tell();
    onChoose(machine?.name ?? null);
  };
  /** Take what was typed where it means one machine; else none: a file for another would be wrong. */
  const settle = () => {
    const text = input.value;
    if (text === (current?.title ?? "")) return choose(current);
    const fits = fitting(text);
    const named = fits.filter((m) => [m.name, m.title].some((word) => word.toLowerCase() === text.trim().toLowerCase()));
    const [meant, ...others] = named.length ? named : fits;
    if (meant && !others.length) return choose(meant);
    choose(null);
    input.value = text;
    if (text.trim() === "") return;
    fill(hint, fits.length ? `“${text}” fits ${counted(fits.length, "machine")}: choose one from the list.` : `No machine has “${text}” in its name: choose one from the list.`);
    announce(hint.textContent);
  };

  input.addEventListener("input", () => search(input.value));
  input.addEventListener("click", () => {
    if (list.hidden) search("");
  });
  input.addEventListener("focus", () => input.select());
  input.addEventListener("blur", settle);
  input.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (step) {
      event.preventDefault();
      if (list.hidden) search("");
      else if (shown.length) {
        active = (active + step + shown.length) % shown.length;
        draw();
      }
    } else if (event.key === "Enter" && !list.hidden) {
      event.preventDefault();
      if (shown[active]) choose(shown[active]);
    } else if (event.key === "Escape" && !list.hidden) {
      event.preventDefault();
      choose(current);
    }
  });
  input.value = current?.title ?? "";
  tell();
  return h("div.picker", null, h("label", { for: "machine" }, "Machine"), input, list, hint);
}

/** @returns {string | null} The machine that this browser named last. */
export function rememberedMachine() {
  try {
    return localStorage.getItem(LAST_MACHINE);
  } catch {
    return null;
  }
}

/** @param {string} name */
export function rememberMachine(name) {
  try {
    localStorage.setItem(LAST_MACHINE, name);
  } catch {
    // Storage may be blocked; the machine is then chosen each time.
  }
}
