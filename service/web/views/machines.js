/** The machines that jobs can name: one's own first, then those that are built in. */

import { getJson } from "../lib/api.js";
import { announce } from "../lib/announce.js";
import { helpLink } from "../lib/controls.js";
import { fill, h } from "../lib/dom.js";
import { measurementPanel } from "../machine/measurement.js";
import { settingsPanel } from "../machine/settings.js";

/** @param {import("../lib/router.js").Place} place */
export async function show({ main, signal, setTitle }) {
  setTitle("Machines");
  const machines = await getJson("/v1/machines", { signal });
  const own = machines.filter((/** @type {any} */ m) => m.origin === "own");
  const builtin = machines.filter((/** @type {any} */ m) => m.origin !== "own");
  const list = h("div");
  const search = h("input", { type: "search", id: "find", placeholder: "Name or title", oninput: () => draw() });
  const draw = () => {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const fits = (/** @type {any} */ m) => words.every((/** @type {string} */ w) => `${m.title} ${m.name}`.toLowerCase().includes(w));
    const found = machines.some(fits);
    if (!found) announce("No machine has such a name.");
    fill(list, !found ? h("p.empty", null, "No machine has such a name.") : null, group("Your own", own.filter(fits), own.length || words.length ? null : "None yet. Make one below."),
      group("Built in", builtin.filter(fits), null));
  };
  draw();
  fill(main,
    h("div.head", null, h("h1", null, "Machines"), h("div.find.end", null, h("label.sr", { for: "find" }, "Find a machine"), search)),
    h("p.lead", null, "A compensator is only as good as its model of the machine. Each built-in machine is one printer that somebody measured, and yours is different."),
    list,
    h("section", null, h("h2", null, "Make your own from the printer's settings"),
      h("p.hint", null, "Limits and travel come from the firmware. How the frame rings is measured afterwards, on the machine's page: ", helpLink("identification", "how"), "."),
      settingsPanel({ machine: null, machines, signal })),
    h("section", null, h("h2", null, "Or from measurements, with another machine's limits"),
      measurementPanel({ machines, base: null, signal })));
}

/** @param {string} title @param {any[]} machines @param {string | null} empty */
function group(title, machines, empty) {
  if (machines.length === 0 && empty === null) return null;
  return h("section", null, h("h2", null, title),
    machines.length ? h("ul.cards", null, machines.map(card)) : h("p.hint", null, empty));
}

/** @param {any} machine */
function card(machine) {
  return h("li.card", null,
    h("h3", null, h("a.cover", { href: `#/machines/${encodeURIComponent(machine.name)}` }, machine.title)),
    machine.problem
      ? h("p.bad", null, machine.problem)
      : [h("p.hint", null, h("code", null, machine.name), ` · ${machine.kinematics}`),
        machine.number ? h("p.hint", null, `Revision ${machine.number}${machine.approved === machine.number ? ", approved" : machine.approved ? `; ${machine.approved} is approved` : ""}`) : h("p.hint.source", null, machine.source)]);
}
