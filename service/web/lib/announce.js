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

const QUARTER = 0.25;

/**
 * Return what says how far something is, a quarter at a time: whatever else changes would wait
 * behind every percent.
 *
 * @returns {(share: number, text: string) => void}
 */
export function announcer() {
  let said = -1;
  return (share, text) => {
    const step = Math.floor(share / QUARTER);
    if (step !== said) announce(text);
    said = step;
  };
}
