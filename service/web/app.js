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
wireThemeSwitch(get("theme"), get("theme-name"));
showForget();
startRouter(get("main"), [
  { name: "new", pattern: /^\/$/, load: () => import("./views/new-job.js") },
  { name: "jobs", pattern: /^\/jobs$/, load: () => import("./views/jobs.js") },
  { name: "jobs", pattern: /^\/jobs\/([^/]+)$/, load: () => import("./views/job.js") },
  { name: "machines", pattern: /^\/machines$/, load: () => import("./views/machines.js") },
  { name: "machines", pattern: /^\/machines\/([^/]+)$/, load: () => import("./views/machine.js") },
]);
