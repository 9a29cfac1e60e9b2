/** Views by the address's hash: `#/jobs/ID`. One is shown at a time, and ends when another comes. */

import { isAbort } from "./api.js";
import { fill, focusHeading, h } from "./dom.js";
import { retryPanel, unreachable } from "./problem.js";

/**
 * @typedef {object} Place Where a view is drawn.
 * @property {HTMLElement} main
 * @property {AbortSignal} signal Aborts when the view is left.
 * @property {(text: string) => void} setTitle
 * @property {string[]} params
 *
 * @typedef {object} Route
 * @property {string} name
 * @property {RegExp} pattern
 * @property {() => Promise<{show: (place: Place) => Promise<void> | void}>} load
 */

/**
 * Show the view of the address, now and whenever it changes.
 *
 * @param {HTMLElement} main
 * @param {Route[]} routes
 */
export function startRouter(main, routes) {
  let leave = new AbortController();
  let first = true;
  /** Routes whose modules did not come. */
  const failed = new Set();
  const show = async () => {
    leave.abort();
    const here = new AbortController();
    leave = here;
    const path = location.hash.replace(/^#/, "") || "/";
    const route = isReadable(path) ? routes.find((r) => r.pattern.test(path)) : undefined;
    mark(route?.name ?? "");
    fill(main, h("p.hint.late", null, "Loading …"));
    window.scrollTo(0, 0);
    const setTitle = (/** @type {string} */ text) => {
      if (!here.signal.aborted) document.title = `${text} · Stillpath`;
    };
    try {
      if (route === undefined) {
        fill(main, h("h1", { tabindex: "-1" }, "No such page"), h("p", null, h("a", { href: "#/" }, "Start a new job")));
        setTitle("No such page");
      } else {
        const params = (route.pattern.exec(path) ?? []).slice(1).map(decodeURIComponent);
        const view = await route.load().catch(async () => {
          const again = failed.has(route);
          failed.add(route);
          if (!await helpsReloading(again)) throw unreachable();
          location.reload();
          return new Promise(() => {}); // the page ends here
        });
        if (here.signal.aborted) return;
        await view.show({ main, signal: here.signal, setTitle, params });
      }
    } catch (error) {
      if (isAbort(error) || here.signal.aborted) return;
      main.querySelector(":scope > .late")?.remove();
      const all = route !== undefined && path.startsWith(`/${route.name}/`) ? [h("a.button", { href: `#/${route.name}` }, `All ${route.name}`)] : [];
      const panel = retryPanel(error, show, ...all);
      if (main.querySelector("h1") === null) setTitle(asHeading(panel));
      main.append(panel);
    }
    if (!first && !here.signal.aborted) focusHeading(main);
    first = false;
  };
  addEventListener("hashchange", () => {
    // The skip link and anchors within a page are no routes.
    if (location.hash === "" || location.hash.startsWith("#/")) show();
  });
  show();
}

/** @param {string} path @returns {boolean} Whether it can be decoded; somebody may have typed it. */
function isReadable(path) {
  try {
    return decodeURIComponent(path) !== "";
  } catch {
    return false;
  }
}

/**
 * Make the title of a problem that is all there is to see the heading.
 *
 * @param {HTMLElement} panel
 * @returns {string} Its text.
 */
function asHeading(panel) {
  const title = panel.querySelector(".title");
  const text = title?.textContent ?? "";
  title?.replaceWith(h("h1.title", null, text));
  return text;
}

/**
 * Return whether the page is to be loaded anew, for a module did not come although the service answers:
 * after an update, modules of two versions do not fit together; and many browsers (Firefox before 155)
 * never fetch again what failed once, so that trying again would not help.
 *
 * @param {boolean} again It is not the first time.
 * @returns {Promise<boolean>}
 */
async function helpsReloading(again) {
  try {
    const page = await (await fetch(location.pathname)).text();
    const version = /\bassets\/\w+\//.exec(page);
    return version !== null && (again || !import.meta.url.includes(version[0]));
  } catch {
    return false;
  }
}

/** @param {string} name */
function mark(name) {
  for (const link of document.querySelectorAll("header nav a")) {
    if (/** @type {HTMLElement} */ (link).dataset.route === name) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}
