/** The list of jobs: newest first, by state, a page at a time. */

import { getJson, isAbort, request } from "../lib/api.js";
import { announce } from "../lib/announce.js";
import { confirmed } from "../lib/dialog.js";
import { fill, focusHeading, h } from "../lib/dom.js";
import { bytes, duration, um, umOrRange, when } from "../lib/format.js";
import { methodTitle } from "../lib/methods.js";
import { problemPanel, retryPanel } from "../lib/problem.js";
import { isOver, pause } from "../lib/watch.js";
import { stateBadge } from "../parts/state.js";

const STATES = [["", "All"], ["queued", "Waiting"], ["running", "Running"], ["done", "Done"], ["failed", "Failed"], ["cancelled", "Cancelled"]];
const PAGE = 25;
const REFRESH_MS = 2000;

/** @param {import("../lib/router.js").Place} place */
export async function show({ main, signal, setTitle }) {
  setTitle("Jobs");
  /** Of the page that somebody comes back to. */
  const kept = history.state?.jobs;
  let state = kept?.state ?? "";
  /** Cursors of the pages before this one, and of this one. @type {(string | null)[]} */
  let cursors = kept?.cursors ?? [null];
  /** @type {any} */
  let page = { jobs: [], next: null };
  let lacksKey = false;
  /** What is shown, by the job's id. @type {Map<string, {text: string, element: HTMLElement}>} */
  let rows = new Map();
  let complaint = "";
  const list = h("div.jobs");
  const newer = h("button", { type: "button", onclick: () => {
    if (cursors.length > 1) cursors.pop();
    reload(true);
  } }, "Newer");
  const older = h("button", { type: "button", onclick: () => {
    if (cursors.at(-1) !== page.next) cursors.push(page.next); // again, where that page did not come
    reload(true);
  } }, "Older");
  const pager = h("nav.pager", { "aria-label": "Pages of jobs" }, newer, older);
  pager.hidden = true; // until it is known whether there are more
  const fault = h("div");
  const filter = h("div.choices", { role: "group", "aria-label": "Show jobs that are" },
    STATES.map(([value, text]) => h("button", {
      type: "button", "aria-pressed": String(value === state), dataset: { value },
      onclick: (/** @type {Event} */ event) => {
        state = value;
        cursors = [null];
        for (const other of filter.children) other.setAttribute("aria-pressed", String(other === event.currentTarget));
        reload(true);
      },
    }, text)));
  fill(main, h("div.head", null, h("h1", null, "Jobs"), h("a.button.main.end", { href: "#/" }, "New job")), h("div.filter", null, filter), fault, list, pager);

  async function reload(tells = false, ask = true) {
    const cursor = cursors.at(-1);
    const wanted = state;
    if (tells) history.replaceState({ jobs: { state, cursors } }, "");
    // Another page or state may have been chosen before the answer comes.
    const isPast = () => cursor !== cursors.at(-1) || wanted !== state;
    try {
      const found = await getJson("/v1/jobs", { query: { state, limit: PAGE, cursor }, signal, ask });
      if (isPast()) return;
      page = found;
      lacksKey = false;
      complain("");
      draw();
      if (tells) announce(page.jobs.length ? `${page.jobs.length} jobs on this page` : "No jobs");
    } catch (/** @type {any} */ error) {
      if (isAbort(error) || isPast()) return;
      lacksKey = error.status === 401;
      complain(error.message, lacksKey ? retryPanel(error, () => reload(true)) : problemPanel(error));
    }
  }

  /** A complaint is said once, not whenever the list is fetched again. */
  function complain(/** @type {string} */ text, /** @type {HTMLElement[]} */ ...panel) {
    if (text === complaint) return;
    complaint = text;
    fill(fault, ...panel);
  }

  /** Rows that are as they were stay in their place: a finger, the focus or a screen reader may be there. */
  function draw() {
    const focused = /** @type {HTMLElement} */ (document.activeElement)?.dataset?.focus;
    const before = rows;
    rows = new Map(page.jobs.map((/** @type {any} */ job) => {
      const text = JSON.stringify(job);
      const known = before.get(job.id);
      return [job.id, known?.text === text ? known : { text, element: row(job) }];
    }));
    if (rows.size && [...rows.keys()].join() === [...before.keys()].join()) {
      for (const [id, { element }] of before) {
        const now = /** @type {any} */ (rows.get(id)).element;
        if (now !== element) element.replaceWith(now);
      }
    } else {
      fill(list, rows.size
        ? h("ul.plain", null, [...rows.values()].map(({ element }) => element))
        : h("p.empty", null, state ? "No jobs are in this state." : "No jobs yet."));
    }
    const turned = [newer, older].find((button) => button === document.activeElement);
    newer.disabled = cursors.length < 2;
    older.disabled = !page.next;
    if (turned?.disabled) (turned === older ? newer : older).focus(); // a disabled one loses it
    pager.hidden = cursors.length < 2 && !page.next;
    if (focused && document.activeElement === document.body) /** @type {HTMLElement | null} */ (list.querySelector(`[data-focus="${CSS.escape(focused)}"]`))?.focus();
  }

  function row(/** @type {any} */ job) {
    const over = isOver(job);
    return h("li.job-row", { dataset: { job: job.id } },
      h("div.what", null,
        h("a.name", { href: `#/jobs/${job.id}`, dataset: { focus: `open-${job.id}` } }, job.source_name),
        h("p.hint", null, `${job.machine} · ${methodTitle(job.options?.method)} · ${bytes(job.source_bytes)} · ${when(job.created_at)}`)),
      h("div.outcome", null, outcome(job)),
      stateBadge(job.state),
      h("button.quiet", { type: "button", dataset: { focus: `end-${job.id}` }, "aria-label": `${over ? "Delete" : "Cancel"} ${job.source_name}`,
        onclick: () => (over ? remove(job) : cancel(job)) }, over ? "Delete" : "Cancel"));
  }

  async function cancel(/** @type {any} */ job) {
    if (!await confirmed({ title: "Cancel this job?", text: `${job.source_name} is not finished. It can be submitted again.`, yes: "Cancel the job", no: "Let it run" })) return;
    await change(() => request(`/v1/jobs/${job.id}/cancel`, { method: "POST", signal }), `${job.source_name} is cancelled.`);
  }

  async function remove(/** @type {any} */ job) {
    if (!await confirmed({ title: "Delete this job?", text: `${job.source_name}, its result and its report are deleted for good.`, yes: "Delete" })) return;
    await change(() => request(`/v1/jobs/${job.id}`, { method: "DELETE", signal }), `${job.source_name} is deleted.`);
  }

  async function change(/** @type {() => Promise<any>} */ act, /** @type {string} */ said) {
    complain("");
    fill(fault);
    try {
      await act();
      announce(said);
      await reload();
      if (!signal.aborted) focusHeading(main);
    } catch (error) {
      if (!isAbort(error)) fill(fault, problemPanel(error));
    }
  }

  await reload();
  refresh().catch(() => {}); // not awaited: it ends when the view is left

  /** One request after the other: where each takes long they would pile up, before what is asked for by hand. */
  async function refresh() {
    while (!signal.aborted) {
      await pause(REFRESH_MS, signal);
      if (!document.hidden && !lacksKey && (cursors.length === 1 || page.jobs.some((/** @type {any} */ j) => !isOver(j)))) await reload(false, false);
    }
  }
}

/** @param {any} job */
function outcome(job) {
  if (job.state === "running") return [h("progress", { max: "1", value: String(job.progress), "aria-label": `Progress of ${job.source_name}` }), h("small", null, job.stage)];
  if (job.state === "queued") return h("small", null, job.queue_position ? `${job.queue_position} before it` : "next");
  if (job.state === "failed") return h("small.bad", null, job.error?.detail ?? job.error?.title ?? "");
  const figures = job.summary;
  if (job.state !== "done" || !figures) return null;
  // Jobs of earlier versions have no headline.
  const { before, after, range } = figures.headline_um ?? { before: figures.before_um, after: figures.after_um };
  if (Number.isFinite(after)) {
    return h("span.figures", null, h("span.before", null, um(before)), " → ", h("span.after", null, umOrRange(after, range)), " µm",
      h("small", null, duration(figures.written_s)));
  }
  return Number.isFinite(before) ? h("span.figures", null, `${um(before)} µm`) : null;
}
