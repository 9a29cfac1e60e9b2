/** Light, dark, or as the system has it; and colours for what is drawn on a canvas. */

const KEY = "stillpath.theme";
const CHOICES = /** @type {const} */ (["system", "light", "dark"]);
const NAMES = { system: "as the system", light: "light", dark: "dark" };
const system = matchMedia("(prefers-color-scheme: dark)");
const listeners = new Set();
/** Older browsers have the light side only (styles/base.css). */
const canBeDark = CSS.supports("color", "light-dark(#000, #fff)");

/** @returns {boolean} */
export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  if (!canBeDark) return false;
  return chosen ? chosen === "dark" : system.matches;
}

/**
 * Return a colour of the style sheet as the browser computes it now.
 *
 * @param {string} name A custom property: `--ink`.
 * @returns {string}
 */
export function colour(name) {
  const probe = document.createElement("i");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}

/**
 * Call back when the theme changes, until the signal aborts.
 *
 * @param {() => void} listener
 * @param {AbortSignal} signal
 */
export function onThemeChange(listener, signal) {
  if (signal.aborted) return;
  listeners.add(listener);
  signal.addEventListener("abort", () => listeners.delete(listener));
}

/**
 * Make a button step through the choices.
 *
 * @param {HTMLButtonElement} button
 * @param {HTMLElement} label
 */
export function wireThemeSwitch(button, label) {
  const show = () => {
    const choice = document.documentElement.dataset.theme ?? "system";
    button.dataset.choice = choice;
    label.textContent = `Theme: ${NAMES[/** @type {keyof NAMES} */ (choice)]}`;
    button.title = label.textContent;
  };
  button.addEventListener("click", () => {
    const now = CHOICES.indexOf(/** @type {any} */ (document.documentElement.dataset.theme ?? "system"));
    choose(CHOICES[(now + 1) % CHOICES.length]);
    show();
  });
  system.addEventListener("change", tell);
  show();
}

/** @param {"system" | "light" | "dark"} choice */
function choose(choice) {
  if (choice === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = choice;
  try {
    localStorage.setItem(KEY, choice);
  } catch {
    // Storage may be blocked; the choice then lasts as long as the page.
  }
  tell();
}

function tell() {
  for (const listener of listeners) listener();
}
