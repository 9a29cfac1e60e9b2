/** The document of a machine: read, changed in an editor, given back; and the machine's end. */

import { isAbort, request } from "../lib/api.js";
import { announce } from "../lib/announce.js";
import { confirmed } from "../lib/dialog.js";
import { fill, h } from "../lib/dom.js";
import { fileLink } from "../lib/files.js";
import { problemPanel } from "../lib/problem.js";
import { dropZone } from "../parts/drop-zone.js";

/** As `service/api/machines.py` has it. */
const LARGEST_BYTES = 4e6;

/**
 * @param {{where: string, name: string, revision: string | null, signal: AbortSignal}} about
 *   `revision`: of a machine of one's own, which may be changed.
 * @returns {HTMLElement}
 */
export function documentPanel({ where, name, revision, signal }) {
  const link = fileLink({ text: "Document (JSON)", href: where, name: `${name}.json` });
  if (revision === null) return h("div.actions", null, link);
  const state = { "If-Match": `"${revision}"` };
  /** @type {File | null} */
  let file = null;
  const status = h("div", { "aria-live": "polite" });
  const keep = h("button.main", { type: "submit", disabled: true }, "Keep the document as the next revision");
  const remove = h("button.quiet.apart", { type: "button", onclick: () => act(async () => {
    if (!await confirmed({ title: `Delete ${name}?`, text: `It moves to the trash, with all its revisions: “stillpath machines restore ${name}” brings it back. Jobs that were handed in go on.`, yes: "Delete" })) return;
    await request(where, { method: "DELETE", headers: state, signal });
    announce(`${name} is deleted.`);
    location.hash = "#/machines";
  }) }, "Delete the machine");
  const form = h("form.card", { onsubmit: (/** @type {Event} */ event) => {
    event.preventDefault();
    act(async () => {
      const made = await (await request(where, { method: "PUT", headers: { "Content-Type": "application/json", ...state }, body: file, signal })).json();
      announce(`Revision ${made.number} of ${name} is kept.`);
      dispatchEvent(new HashChangeEvent("hashchange"));
    });
  } },
  dropZone({ label: "Choose the changed document, or drop it here", hint: "The JSON file that “Document” downloads", onChoose: ([chosen]) => {
    file = chosen;
    keep.disabled = chosen.size > LARGEST_BYTES;
    fill(status, keep.disabled ? problemPanel({ title: "Not a machine's document", detail: `${chosen.name} is larger than 4 MB, which no machine's document is. Choose another file.` }) : null);
  } }),
  h("div.actions", null, keep, link, remove), status);
  return h("div", null,
    h("p.hint", null, "What no form here asks for (travel, limits of the motors, what M503 does not say) stands in the machine's document. Download it, change it in an editor, and give it back."), form);

  async function act(/** @type {() => Promise<void>} */ what) {
    fill(status);
    try {
      await what();
    } catch (error) {
      if (!isAbort(error)) fill(status, problemPanel(error));
    }
  }
}
