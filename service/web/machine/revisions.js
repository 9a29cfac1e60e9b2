/** The history of a machine: who changed what, approval, going back. */

import { getJson, isAbort, request } from "../lib/api.js";
import { announce } from "../lib/announce.js";
import { confirmed } from "../lib/dialog.js";
import { fill, h, keepingFocus } from "../lib/dom.js";
import { when } from "../lib/format.js";
import { problemPanel } from "../lib/problem.js";
import { table } from "../parts/table.js";

/**
 * @param {string} where Address of the machine.
 * @param {string} name
 * @param {AbortSignal} signal
 * @returns {Promise<HTMLElement>}
 */
export async function revisionPanel(where, name, signal) {
  const area = h("div");
  const fault = h("div");
  const changes = h("div", { "aria-live": "polite" });
  const element = h("div", null, area, fault, changes);

  async function load() {
    const { revisions, drift } = await getJson(`${where}/revisions`, { signal });
    const newest = [...revisions].reverse();
    keepingFocus(area, () => fill(area,
      drift.length ? h("ul.notice", null, drift.map((/** @type {any} */ d) => h("li", null, d.text))) : null,
      table("Revisions, newest first", [{ title: "Revision", text: true }, { title: "Who and why", text: true }, { title: "Approved", text: true }],
        newest.map((r, k) => [
          h("span.stacked", null, h("b", null, String(r.number)), h("small", null, when(r.when))),
          h("span.stacked", null, r.author, h("small", null, r.restored ? `Back to ${r.restored}. ${r.message}` : r.message || "–")),
          h("div.row-actions", null,
            r.approval ? h("span.badge", { dataset: { state: "done" }, title: when(r.approval.when) }, `by ${r.approval.author}`) : h("button", { type: "button", "aria-label": `Approve revision ${r.number}`, onclick: () => approve(r.number) }, "Approve"),
            k === 0 ? null : h("button", { type: "button", "aria-label": `Go back to revision ${r.number}`, onclick: () => rollBack(r.number, newest[0]) }, "Go back")),
        ])),
      revisions.length > 1 ? comparison(newest) : null));
  }

  function comparison(/** @type {any[]} */ revisions) {
    const option = (/** @type {any} */ r, /** @type {number} */ chosen) => h("option", { value: r.number, selected: r.number === chosen }, `${r.number}`);
    const from = h("select", { id: "diff-from" }, revisions.map((r) => option(r, revisions[1].number)));
    const to = h("select", { id: "diff-to" }, revisions.map((r) => option(r, revisions[0].number)));
    return h("form.compare", { onsubmit: (/** @type {Event} */ event) => {
      event.preventDefault();
      act(async () => show(await getJson(`${where}/diff`, { query: { from: from.value, to: to.value }, signal })));
    } }, h("label", { for: "diff-from" }, "Compare revision"), from, h("label", { for: "diff-to" }, "with"), to, h("button", { type: "submit" }, "Show differences"));
  }

  function show(/** @type {any} */ diff) {
    fill(changes, h("h3", null, `From ${diff.before} to ${diff.after}`), diff.changes.length
      ? table(`Differences from ${diff.before} to ${diff.after}`, [{ title: "What", text: true }, { title: "Change" }, { title: "Place", text: true, wide: true }],
        diff.changes.map((/** @type {any} */ c) => [c.text, c.percent === null ? "" : `${c.percent > 0 ? "+" : ""}${c.percent.toFixed(1)} %`, h("code", null, c.place)]))
      : h("p.hint", null, "They do not differ."));
  }

  async function approve(/** @type {number} */ number) {
    const asked = await who({ title: `Approve revision ${number}?`, text: `Jobs may then use this state of ${name}. An approval cannot be taken back.`, yes: "Approve", no: "Not now", danger: false });
    if (asked) await change(`/revisions/${number}/approve`, asked, {}, `Revision ${number} is approved.`, load);
  }

  async function rollBack(/** @type {number} */ number, /** @type {any} */ newest) {
    const asked = await who({ title: `Go back to revision ${number}?`, text: "Its state comes back as a new revision; nothing is lost.", yes: "Go back", no: "Stay" });
    if (asked) await change(`/revisions/${number}/rollback`, asked, { "If-Match": `"${newest.revision}"` }, `Back to revision ${number}.`,
      // All of the page shows the newest revision.
      () => dispatchEvent(new HashChangeEvent("hashchange")));
  }

  async function change(/** @type {string} */ path, /** @type {Record<string, string>} */ query, /** @type {Record<string, string>} */ headers, /** @type {string} */ said, /** @type {() => any} */ redraw) {
    await act(async () => {
      await request(where + path, { method: "POST", query, headers, signal });
      announce(said);
      await redraw();
    });
  }

  async function act(/** @type {() => Promise<any>} */ what) {
    try {
      fill(fault);
      await what();
    } catch (error) {
      if (!isAbort(error)) fill(fault, problemPanel(error));
    }
  }

  await load();
  return element;
}

/** Ask, with name and reason. @param {any} question @returns {Promise<Record<string, string> | null>} */
async function who(question) {
  const author = h("input", { type: "text", id: "author", maxlength: "100", autocomplete: "name", placeholder: "unknown" });
  const message = h("input", { type: "text", id: "message", maxlength: "500" });
  const yes = await confirmed({ ...question, fields: [
    h("div.field", null, h("label", { for: "author" }, "Your name"), author),
    h("div.field", null, h("label", { for: "message" }, "Why"), message)] });
  return yes ? { author: author.value.trim(), message: message.value.trim() } : null;
}
