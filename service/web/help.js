/** Pages of the documentation: only what stands above them needs a script. */

import { forgetKey, showForget } from "./lib/keys.js";
import { wireThemeSwitch } from "./lib/theme.js";

const get = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));

get("forget-key").addEventListener("click", forgetKey);
showForget();
wireThemeSwitch(get("theme"), get("theme-name"));
