/** The page: its views and what stands above them. */

import { forgetKey, showForget } from "./lib/keys.js";
import { startRouter } from "./lib/router.js";
import { wireThemeSwitch } from "./lib/theme.js";

const get = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));

get("skip").addEventListener("click", (/** @type {Event} */ event) => {
  event.preventDefault();
  get("main").focus();
});
get("forget-key").addEventListener("click", forgetKey);
// A wrong value in a folded part would keep its form from being sent, and the browser could not show it.
addEventListener("invalid", (event) => {
  const folded = /** @type {Element} */ (event.target).closest("details");
  if (folded) folded.open = true;
}, true);
// A file that misses its place must not open instead of the page.
for (const kind of /** @type {const} */ (["dragover", "drop"])) {
  addEventListener(kind, (event) => {
    if (event.defaultPrevented || !event.dataTransfer?.types.includes("Files")) return;
    event.preventDefault();
    event.dataTransfer.dropEffect = "none";
  });
}
wireThemeSwitch(get("theme"), get("theme-name"));
showForget();
startRouter(get("main"), [
  { name: "new", pattern: /^\/$/, load: () => import("./views/new-job.js") },
  { name: "jobs", pattern: /^\/jobs$/, load: () => import("./views/jobs.js") },
  { name: "jobs", pattern: /^\/jobs\/([^/]+)$/, load: () => import("./views/job.js") },
  { name: "machines", pattern: /^\/machines$/, load: () => import("./views/machines.js") },
  { name: "machines", pattern: /^\/machines\/([^/]+)$/, load: () => import("./views/machine.js") },
]);
