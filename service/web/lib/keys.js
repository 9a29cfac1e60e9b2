/** The key of the service: kept for as long as the tab is open, asked for when it is missing. */

import { helpLink } from "./controls.js";
import { h } from "./dom.js";

const STORED = "stillpath.key";
/** @type {Promise<boolean> | null} */
let asking = null;
/** @type {string | null} Kept here where the browser lets the tab store nothing. */
let unstored = null;

/** @returns {string | null} */
export function storedKey() {
  try {
    return sessionStorage.getItem(STORED) ?? unstored;
  } catch {
    return unstored;
  }
}

/** @returns {Record<string, string>} Headers that show the key, if there is one. */
export function keyHeaders() {
  const key = storedKey();
  return key ? { Authorization: `Bearer ${key}` } : {};
}

/** Forget the key and start anew. */
export function forgetKey() {
  try {
    sessionStorage.removeItem(STORED);
  } catch {
    // It is nowhere but in this page, which ends now.
  }
  location.reload();
}

/**
 * Ask for a key; requests that wait for one share the question.
 *
 * @param {string} reason What the service said of the one that was shown.
 * @returns {Promise<boolean>} Whether one was given.
 */
export function askForKey(reason) {
  asking ??= ask(keyProblem(reason)).finally(() => {
    asking = null;
  });
  return asking;
}

/**
 * @param {string} reason What the service said of the key that was shown.
 * @returns {{title: string, detail: string, status: number}}
 */
export function keyProblem(reason) {
  // Without one before, nothing is wrong yet.
  const detail = storedKey() === null ? "Enter one to submit files and to see your own jobs." : reason;
  return { title: "This service asks for a key", detail, status: 401 };
}

/** @param {{title: string, detail: string}} problem @returns {Promise<boolean>} */
function ask({ title, detail }) {
  return new Promise((resolve) => {
    const field = h("input", {
      type: "password", id: "key", name: "key", autocomplete: "off", spellcheck: "false",
      required: true, placeholder: "sp_…", "aria-describedby": "key-reason",
      // No header holds other characters: no request could be sent any more.
      pattern: "\\s*[!-~]+\\s*", title: "Letters, digits, - and _; copy the whole key again",
    });
    const dialog = h("dialog.ask", { "aria-labelledby": "key-title" },
      h("form", { method: "dialog", onsubmit: () => {
        dialog.returnValue = "given";
      } },
        h("h2", { id: "key-title" }, title),
        h("p", { id: "key-reason" }, detail),
        h("label", { for: "key" }, "Key"),
        field,
        h("p.hint", null, "It is kept in this tab only. Whoever runs the service makes ", helpLink("howto/keys", "keys"), " with “stillpath keys”."),
        h("div.actions", null,
          h("button.main", { type: "submit", value: "given" }, "Use this key"),
          h("button", { type: "button", onclick: () => dialog.close("") }, "Not now")),
      ));
    dialog.addEventListener("close", () => {
      const key = field.value.trim();
      const given = dialog.returnValue === "given" && key !== "";
      if (given) store(key);
      showForget();
      dialog.remove();
      resolve(given);
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}

/** @param {string} key */
function store(key) {
  unstored = key;
  try {
    sessionStorage.setItem(STORED, key);
  } catch {
    // Then it lasts until the page is left.
  }
}

/** Show the button that forgets the key while there is one. */
export function showForget() {
  const button = document.getElementById("forget-key");
  if (button) button.hidden = storedKey() === null;
}
