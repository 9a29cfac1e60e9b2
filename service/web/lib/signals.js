/** What waits may be ended for several reasons. */

/**
 * Return a signal that aborts with either of two.
 *
 * @param {AbortSignal} one
 * @param {AbortSignal} other
 * @returns {AbortSignal}
 */
export function either(one, other) {
  // Browsers of before 2024 lack it, such as all on phones whose updates ended with iOS 16.
  if (AbortSignal.any) return AbortSignal.any([one, other]);
  const both = new AbortController();
  for (const signal of [one, other]) {
    if (signal.aborted) both.abort(signal.reason);
    signal.addEventListener("abort", () => both.abort(signal.reason), { once: true, signal: both.signal });
  }
  return both.signal;
}
