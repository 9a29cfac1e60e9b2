/** What went wrong, as the service says it (RFC 9457) or as the browser does. */

import { inOurWords } from "./controls.js";
import { h } from "./dom.js";

/** An answer that is no success. */
export class ProblemError extends Error {
  /** @param {Record<string, any>} document */
  constructor(document) {
    super(document.detail ?? document.title ?? "Something went wrong.");
    this.name = "ProblemError";
    this.document = document;
    this.status = document.status ?? 0;
  }
}

/** @returns {ProblemError} For a service that cannot be reached. */
export function unreachable() {
  return new ProblemError({
    title: "The service does not answer",
    detail: "Nothing came back. Check that it is running and that this computer can reach it, then try again.",
    status: 0,
  });
}

/**
 * Return the problem of an answer, whatever its body is.
 *
 * @param {number} status
 * @param {string} text
 * @returns {ProblemError}
 */
export function problemOf(status, text) {
  try {
    const document = JSON.parse(text);
    if (document && typeof document === "object" && (document.detail || document.title)) {
      return new ProblemError({ status, ...document });
    }
  } catch {
    // Not ours: something between here and the service answered.
  }
  return new ProblemError({
    title: `Status ${status}`,
    status,
    detail: `The answer is not from Stillpath: ${text.trim().slice(0, 200) || "empty"}. Check what stands in front of the service.`,
  });
}

/**
 * Return a panel that tells a problem: title, text with the remedy, and the line of the file.
 *
 * @param {unknown} error A ProblemError, or a problem document.
 * @param {...Node} actions
 * @returns {HTMLElement}
 */
export function problemPanel(error, ...actions) {
  const document = error instanceof ProblemError ? error.document : asDocument(error);
  return h(
    "div.problem",
    { role: "alert" },
    h("p.title", null, document.title ?? "Something went wrong"),
    h("p", null, inOurWords(document.detail ?? "")),
    document.text ? h("pre", { tabindex: "0", "aria-label": "The line of the file" },
      document.line ? `${document.line}: ${document.text}` : document.text) : null,
    actions.length ? h("div.actions", null, actions) : null,
  );
}

/**
 * Return the panel of a problem that may be over when it is tried again.
 *
 * @param {any} error
 * @param {() => any} retry
 * @param {...Node} actions
 * @returns {HTMLElement}
 */
export function retryPanel(error, retry, ...actions) {
  const text = error?.status === 401 ? "Enter a key" : "Try again";
  return problemPanel(error, h("button", { type: "button", onclick: retry }, text), ...actions);
}

/** @param {unknown} error @returns {Record<string, any>} */
function asDocument(error) {
  if (error instanceof Error) {
    console.warn(error);
    return { title: "The page broke", detail: `${error.message}. Reload the page; if that does not help, report it.` };
  }
  return /** @type {any} */ (error) ?? {};
}
