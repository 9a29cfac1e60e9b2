/** Questions before something is lost. */

import { focusHeading, h } from "./dom.js";

/**
 * Ask; the safe answer has the focus.
 *
 * @param {{title: string, text: string, yes: string, no?: string, danger?: boolean, fields?: Node[]}} question
 * @returns {Promise<boolean>}
 */
export function confirmed({ title, text, yes, no = "Keep it", danger = true, fields = [] }) {
  const before = /** @type {HTMLElement | null} */ (document.activeElement);
  return new Promise((resolve) => {
    const dialog = h("dialog.ask", { "aria-labelledby": "ask-title", "aria-describedby": "ask-text" },
      h("form", { method: "dialog" },
        h("h2", { id: "ask-title" }, title),
        h("p", { id: "ask-text" }, text),
        fields,
        h("div.actions", null,
          h(danger ? "button.danger" : "button.main", { type: "submit", value: "yes" }, yes),
          h("button", { type: "button", autofocus: fields.length === 0, onclick: () => dialog.close("") }, no))));
    // Back, on a phone the way out of everything, means no, and leads to another page.
    const left = () => dialog.close("");
    addEventListener("hashchange", left);
    dialog.addEventListener("close", () => {
      removeEventListener("hashchange", left);
      dialog.remove();
      returnFocus(before);
      resolve(dialog.returnValue === "yes");
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}

/** What asked may have been drawn anew meanwhile. @param {HTMLElement | null} before */
function returnFocus(before) {
  const again = before?.dataset.focus && document.querySelector(`[data-focus="${CSS.escape(before.dataset.focus)}"]`);
  const to = /** @type {HTMLElement | null} */ (before?.isConnected ? before : again || null);
  const main = document.querySelector("main");
  if (to !== null) to.focus();
  else if (main !== null) focusHeading(main);
}
