/**
 * Follows a job: by the service's stream of events, or by asking while there is none.
 *
 * Browsers have six connections to a service, over all tabs, and a stream holds one. So there is one
 * only while its tab is looked at: the seventh tab would wait for as long as the jobs of the others.
 */

import { getJson, request } from "./api.js";
import { ProblemError } from "./problem.js";
import { either } from "./signals.js";

const FINAL = new Set(["done", "failed", "cancelled"]);
const ASK_EVERY_MS = 1000;
const SLOWEST_MS = 15_000;
const HIDDEN_MS = 5000;
/** The stream says every 15 s that it is there; of a broken connection browsers may not tell for minutes. */
const QUIET_MS = 45_000;

/**
 * @param {{state: string}} job
 * @returns {boolean} Whether nothing more will happen.
 */
export function isOver(job) {
  return FINAL.has(job.state);
}

/**
 * Call back with every new state of a job until it ends.
 *
 * @param {string} id
 * @param {(job: any) => void} onJob
 * @param {AbortSignal} signal
 * @param {() => void} [onSilence] The service does not answer; it is asked again.
 * @returns {Promise<void>} Rejected with the problem if there is no such job (any more).
 */
export async function watchJob(id, onJob, signal, onSilence = () => {}) {
  let over = false;
  let streams = true;
  let wait = ASK_EVERY_MS;
  const note = (/** @type {any} */ job) => {
    over = isOver(job);
    wait = ASK_EVERY_MS;
    onJob(job);
  };
  while (!over) {
    const turned = new AbortController(); // the tab is hidden, or looked at again
    const turn = () => turned.abort();
    const here = either(signal, turned.signal);
    document.addEventListener("visibilitychange", turn);
    try {
      try {
        if (streams && !document.hidden) await whileHeard(here, (still, heard) => follow(id, note, still, heard));
        else note(await getJson(`/v1/jobs/${id}`, { signal }));
      } catch (error) {
        if (here.aborted) throw error;
        if (error instanceof ProblemError && [401, 403, 404].includes(error.status) && !streams) throw error;
        if (!streams) onSilence();
        streams = false;
        wait = Math.min(wait * 1.5, SLOWEST_MS);
      }
      if (!over) await pause(document.hidden ? Math.max(wait, HIDDEN_MS) : wait, here);
    } catch (error) {
      if (signal.aborted || !turned.signal.aborted) throw error;
    } finally {
      document.removeEventListener("visibilitychange", turn);
    }
  }
}

/**
 * Give something up that is silent for too long.
 *
 * @param {AbortSignal} signal
 * @param {(still: AbortSignal, heard: () => void) => Promise<void>} listen
 */
async function whileHeard(signal, listen) {
  const quiet = new AbortController();
  let timer = 0;
  const heard = () => {
    clearTimeout(timer);
    timer = setTimeout(() => quiet.abort(), QUIET_MS);
  };
  heard();
  try {
    await listen(either(signal, quiet.signal), heard);
  } finally {
    clearTimeout(timer);
  }
}

/**
 * Read `text/event-stream` (WHATWG HTML, 9.2) as far as jobs need it.
 *
 * @param {string} id
 * @param {(job: any) => void} onJob
 * @param {AbortSignal} signal
 * @param {() => void} heard Called with whatever comes.
 */
async function follow(id, onJob, signal, heard) {
  const answer = await request(`/v1/jobs/${id}/events`, {
    headers: { Accept: "text/event-stream" }, signal,
  });
  if (!answer.body) throw new TypeError("no stream");
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    heard();
    if (done) return;
    text += value.replaceAll("\r\n", "\n").replaceAll("\r", "\n");
    const events = text.split("\n\n");
    text = events.pop() ?? "";
    for (const event of events) {
      const lines = event.split("\n");
      const data = lines.filter((line) => line.startsWith("data:")).map((line) => line.slice(5).trimStart()).join("\n");
      // For `gone` and unknown events, ask for the job.
      if (!lines.includes("event: job")) {
        if (data) onJob(await getJson(`/v1/jobs/${id}`, { signal }));
      } else onJob(JSON.parse(data));
    }
  }
}

/** @param {number} ms @param {AbortSignal} signal @returns {Promise<void>} */
export function pause(ms, signal) {
  return new Promise((resolve, reject) => {
    const stop = () => {
      clearTimeout(timer);
      reject(new DOMException("nobody waits", "AbortError"));
    };
    const timer = setTimeout(() => {
      signal.removeEventListener("abort", stop);
      resolve();
    }, ms);
    signal.addEventListener("abort", stop, { once: true });
  });
}
