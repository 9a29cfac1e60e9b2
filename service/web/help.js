/** Pages of the documentation: only what stands above them needs a script. */

import { wireThemeSwitch } from "./lib/theme.js";

const get = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));

wireThemeSwitch(get("theme"), get("theme-name"));
