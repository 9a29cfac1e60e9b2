/** Requests to the service: the key goes along, problems are thrown. */

import { askForKey, keyHeaders, keyProblem, storedKey } from "./keys.js";
import { ProblemError, problemOf, unreachable } from "./problem.js";

const LOOK_MS = 1000;

/**
 * @typedef {object} Asking
 * @property {string} [method]
 * @property {Record<string, any>} [query] Empty values are left out.
 * @property {BodyInit} [body]
 * @property {Record<string, string>} [headers]
 * @property {AbortSignal} [signal]
 * @property {boolean} [ask] Whether a missing key is asked for; not where nobody waits for the answer.
 */

/**
 * Send a request; a missing key is asked for and the request repeated.
 *
 * @param {string} path
 * @param {Asking} [asking]
 * @returns {Promise<Response>} A success.
 */
export async function request(path, asking = {}) {
  const { ask = true } = asking;
  for (;;) {
    const shown = storedKey();
    const answer = await send(path, asking);
    if (answer.ok) return answer;
    const problem = problemOf(answer.status, await answer.text());
    if (answer.status !== 401) throw problem;
    // Another request may have been given a key meanwhile.
    if (storedKey() === shown && !(ask && await askForKey(problem.message))) throw new ProblemError(keyProblem(problem.message));
  }
}

/**
 * @param {string} path
 * @param {Asking} [asking]
 * @returns {Promise<any>}
 */
export async function getJson(path, asking = {}) {
  return (await request(path, asking)).json();
}

/**
 * Send a request that a job answers. Where that takes longer than the service waits, wait for the
 * job and ask again: the same request is then answered at once.
 *
 * @param {string} path
 * @param {Asking} [asking]
 * @param {(job: any) => void} [onProgress]
 * @returns {Promise<Response>} A success.
 */
export async function computed(path, asking = {}, onProgress = () => {}) {
  const { signal } = asking;
  for (;;) {
    const answer = await request(path, asking);
    if (answer.status !== 202) return answer;
    let job = await answer.json();
    while (["queued", "running"].includes(job.state)) {
      onProgress(job);
      await pause(LOOK_MS, signal);
      job = await getJson(job.links.self, { signal });
    }
    if (job.state === "failed") throw problemOf(job.error.status, JSON.stringify(job.error));
    if (job.state === "cancelled") throw new ProblemError({ title: "Job cancelled", detail: "Somebody cancelled it. Ask again for the result.", status: 409 });
  }
}

/**
 * Return an address that counts from the page's own: a proxy may have the service below a path.
 *
 * @param {string} path As the service knows it, or from here.
 * @param {Record<string, any>} [query]
 * @returns {string}
 */
export function address(path, query = {}) {
  const here = path.replace(/^\//, "");
  const given = Object.entries(query).filter(([, v]) => v !== null && v !== undefined && v !== "");
  const text = new URLSearchParams(given.map(([k, v]) => [k, String(v)])).toString();
  return text ? `${here}?${text}` : here;
}

/**
 * Send a file as the body, telling how much of it is on its way; `fetch` cannot tell that.
 *
 * @param {string} path
 * @param {Record<string, any>} query
 * @param {Blob} body
 * @param {(share: number) => void} onProgress
 * @param {AbortSignal} signal
 * @returns {Promise<any>} The answer's document.
 */
export async function upload(path, query, body, onProgress, signal) {
  for (;;) {
    const shown = storedKey();
    const { status, text } = await post(address(path, query), body, onProgress, signal);
    if (status >= 200 && status < 300) return JSON.parse(text);
    const problem = problemOf(status, text);
    if (status !== 401) throw problem;
    if (storedKey() === shown && !(await askForKey(problem.message))) throw new ProblemError(keyProblem(problem.message));
  }
}

/**
 * @param {unknown} error
 * @returns {boolean} Whether it only says that nobody waits any more.
 */
export function isAbort(error) {
  return error instanceof DOMException && error.name === "AbortError";
}

/** @param {number} ms @param {AbortSignal} [signal] @returns {Promise<void>} */
function pause(ms, signal) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, ms);
    signal?.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(new DOMException("Nobody waits any more.", "AbortError"));
    }, { once: true });
  });
}

/**
 * Say why nothing came back: files that were saved anew since they were chosen cannot be read.
 *
 * @param {BodyInit | undefined} body
 * @returns {Promise<ProblemError>}
 */
export async function silence(body) {
  for (const part of body instanceof FormData ? body.values() : [body]) {
    if (!(part instanceof File)) continue;
    try {
      await part.slice(0, 1).arrayBuffer();
    } catch {
      return new ProblemError({ title: "The file has changed", detail: `${part.name} has changed since it was chosen. Choose it again.` });
    }
  }
  return unreachable();
}

/** @param {string} path @param {Asking} asking @returns {Promise<Response>} */
async function send(path, { method = "GET", query, body, headers, signal }) {
  try {
    return await fetch(address(path, query), {
      method, body, signal, headers: { ...headers, ...keyHeaders() },
    });
  } catch (error) {
    if (isAbort(error)) throw error;
    throw await silence(body);
  }
}

/**
 * @param {string} url
 * @param {Blob} body
 * @param {(share: number) => void} onProgress
 * @param {AbortSignal} signal
 * @returns {Promise<{status: number, text: string}>}
 */
function post(url, body, onProgress, signal) {
  return new Promise((resolve, reject) => {
    signal.throwIfAborted(); // the page may have been left while a key was asked for
    const sending = new XMLHttpRequest();
    sending.open("POST", url);
    sending.setRequestHeader("Content-Type", "application/octet-stream");
    for (const [name, value] of Object.entries(keyHeaders())) sending.setRequestHeader(name, value);
    sending.upload.onprogress = (event) => onProgress(event.total ? event.loaded / event.total : 0);
    sending.onerror = async () => reject(await silence(body));
    sending.onabort = () => reject(new DOMException("The upload was cancelled.", "AbortError"));
    sending.onload = () => resolve({ status: sending.status, text: sending.responseText });
    signal.addEventListener("abort", () => sending.abort());
    sending.send(body);
  });
}
