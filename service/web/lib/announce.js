/** Says to screen readers what sighted people see change. */

/**
 * @param {string} text
 */
export function announce(text) {
  const live = document.getElementById("live");
  if (!live) return;
  // The same text twice is no change, and is not spoken.
  live.textContent = "";
  requestAnimationFrame(() => {
    live.textContent = text;
  });
}
