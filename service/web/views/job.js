/** One job: how far it is, then what came of it. */

import { getJson, isAbort, request } from "../lib/api.js";
import { announce } from "../lib/announce.js";
import { confirmed } from "../lib/dialog.js";
import { fill, h, keepingFocus } from "../lib/dom.js";
import { bytes, when } from "../lib/format.js";
import { methodTitle } from "../lib/methods.js";
import { problemPanel, retryPanel } from "../lib/problem.js";
import { isOver, watchJob } from "../lib/watch.js";
import { stateBadge } from "../parts/state.js";
import { showDeliveries } from "../job/deliveries.js";
import { downloads } from "../job/downloads.js";
import { progressPanel } from "../job/progress.js";
import { reportSections } from "../job/report.js";

/** @param {import("../lib/router.js").Place} place */
export async function show({ main, signal, setTitle, params: [id] }) {
  const first = await getJson(`/v1/jobs/${encodeURIComponent(id)}`, { signal });
  setTitle(first.source_name);
  const badge = h("span");
  const actions = h("div.actions");
  const body = h("div");
  const sent = h("div");
  const fault = h("div");
  fill(main,
    h("p.crumb", null, h("a", { href: "#/jobs" }, "Jobs"), " / "),
    h("div.head", null, h("h1", null, first.source_name), badge),
    h("p.lead", null, subtitle(first)), actions, fault, sent, body);
  const progress = progressPanel();
  let state = "";

  const draw = (/** @type {any} */ job) => {
    if (!isOver(job)) progress.update(job);
    if (job.state === state) return;
    const isNews = state !== "";
    state = job.state;
    fill(badge, stateBadge(state));
    keepingFocus(actions, () => fill(actions, isOver(job) ? deleteButton(job) : cancelButton(job)));
    if (isOver(job)) showDeliveries(sent, job, signal);
    if (!isOver(job)) fill(body, progress.element);
    else if (state === "done") {
      actions.prepend(downloads(job));
      finished(job);
    }
    else if (state === "failed") fill(body, problemPanel(job.error, again()));
    else fill(body, h("p.empty", null, "This job was cancelled; nothing was written."), again());
    if (isNews) announce(`${job.source_name}: ${state}`);
  };

  async function finished(/** @type {any} */ job) {
    const area = h("div", { "aria-busy": "true" }, h("p.hint", null, "Fetching the report …"));
    fill(body, area);
    try {
      const report = await getJson(`/v1/jobs/${job.id}/report.json`, { signal });
      fill(area, ...reportSections(job, report, signal));
    } catch (error) {
      if (!isAbort(error)) fill(area, retryPanel(error, () => finished(job)));
    }
    area.removeAttribute("aria-busy");
  }

  function cancelButton(/** @type {any} */ job) {
    return h("button", { type: "button", onclick: () => act(async () => {
      if (!await confirmed({ title: "Cancel this job?", text: `${job.source_name} is not finished. It can be submitted again.`, yes: "Cancel the job", no: "Let it run" })) return;
      draw(await (await request(`/v1/jobs/${job.id}/cancel`, { method: "POST", signal })).json());
    }) }, "Cancel");
  }

  function deleteButton(/** @type {any} */ job) {
    return h("button.quiet.apart", { type: "button", onclick: () => act(async () => {
      if (!await confirmed({ title: "Delete this job?", text: `${job.source_name}, its result and its report are deleted for good.`, yes: "Delete" })) return;
      await request(`/v1/jobs/${job.id}`, { method: "DELETE", signal });
      announce(`${job.source_name} is deleted.`);
      location.hash = "#/jobs";
    }) }, "Delete");
  }

  async function act(/** @type {() => Promise<void>} */ what) {
    try {
      fill(fault);
      await what();
    } catch (error) {
      if (!isAbort(error)) fill(fault, problemPanel(error));
    }
  }

  draw(first);
  if (isOver(first)) return;
  // Not awaited: the view is shown, and changes as the job does.
  watchJob(first.id, draw, signal, progress.silence).catch((error) => {
    if (!isAbort(error)) fill(fault, problemPanel(error));
  });
}

/** @param {any} job */
function subtitle(job) {
  const options = job.options ?? {};
  return [
    h("a", { href: `#/machines/${encodeURIComponent(job.machine)}` }, job.machine),
    job.machine_revision ? h("span", null, " ", h("code", null, job.machine_revision)) : null,
    options.method === "live" ? ` · ${methodTitle("live")}`
      : ` · ${methodTitle(options.method)}${options.robust && options.robust !== "auto" ? `, ${options.robust}` : ""} · tolerance ${options.tolerance_um} µm`,
    ` · ${bytes(job.source_bytes)} · ${when(job.created_at)}`,
  ];
}

function again() {
  return h("a.button", { href: "#/" }, "Submit another file");
}
