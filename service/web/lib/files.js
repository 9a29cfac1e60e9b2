/** Downloads: plain links, or where a key must go along by way of a blob or of a signed link. */

import { address, getJson, isAbort, request } from "./api.js";
import { fill, h } from "./dom.js";
import { storedKey } from "./keys.js";
import { problemPanel } from "./problem.js";

/**
 * Return a link to a file of the service.
 *
 * @param {{text: string, href: string, name: string, main?: boolean, open?: boolean, signed?: string}} file
 *   `open`: in a tab of its own, where that is possible. `signed`: where a link is made that needs no
 *   key, for a file that may be larger than what a page can hold.
 * @returns {HTMLElement}
 */
export function fileLink({ text, href: path, name, main = false, open = false, signed }) {
  const href = address(path);
  const style = main ? "a.button.main" : "a.button";
  if (storedKey() === null) {
    return h(style, open ? { href, target: "_blank", rel: "noopener" } : { href, download: name },
      text, open ? h("span.sr", null, " (new tab)") : null);
  }
  /** @type {HTMLElement | undefined} */
  let fault;
  const link = h(style, { href, download: name, onclick: async (/** @type {Event} */ event) => {
    event.preventDefault();
    if (link.getAttribute("aria-busy")) return;
    link.setAttribute("aria-busy", "true");
    fault?.remove();
    try {
      if (signed) download(address((await getJson(signed, { method: "POST" })).href), name);
      else save(await whole(await request(href), (share) => fill(link, `${text}: ${Math.floor(100 * share)} %`)), name);
    } catch (error) {
      fault = problemPanel(error);
      if (!isAbort(error)) link.after(fault);
    } finally {
      fill(link, text);
      link.removeAttribute("aria-busy");
    }
  } }, text);
  return link;
}

/**
 * Return what an answer brings, telling how much of it is here: results may take minutes, and of
 * what a page fetches itself browsers show nothing.
 *
 * @param {Response} answer
 * @param {(share: number) => void} onProgress
 * @returns {Promise<Blob>}
 */
function whole(answer, onProgress) {
  const size = Number(answer.headers.get("Content-Length"));
  if (!answer.body || !size) return answer.blob();
  let come = 0;
  const counted = answer.body.pipeThrough(new TransformStream({
    transform(chunk, controller) {
      come += chunk.length;
      onProgress(Math.min(come / size, 1));
      controller.enqueue(chunk);
    },
  }));
  return new Response(counted, { headers: answer.headers }).blob();
}

/**
 * Let the browser save what has been fetched.
 *
 * @param {Blob} content
 * @param {string} name
 */
export function save(content, name) {
  const href = URL.createObjectURL(content);
  download(href, name);
  setTimeout(() => URL.revokeObjectURL(href), 60_000);
}

/** @param {string} href @param {string} name */
function download(href, name) {
  const link = h("a", { href, download: name });
  document.body.append(link);
  link.click();
  link.remove();
}
