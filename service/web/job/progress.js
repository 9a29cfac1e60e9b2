/** A job's progress: its place in the queue, then stage, share and time left. */

import { announcer } from "../lib/announce.js";
import { fill, h } from "../lib/dom.js";
import { capital, counted, remaining } from "../lib/format.js";

/**
 * @returns {{element: HTMLElement, update: (job: any) => void, silence: () => void}}
 */
export function progressPanel() {
  const bar = h("progress", { max: "1", "aria-label": "Progress" });
  const stage = h("p.doing");
  const left = h("p.hint.left");
  const share = h("p.share", { "aria-hidden": "true" });
  const element = h("section.card.progress", { "aria-label": "Progress" }, h("div.row", null, stage, share), bar, left);
  const announce = announcer();
  const update = (/** @type {any} */ job) => {
    if (job.state === "queued") {
      bar.removeAttribute("value");
      fill(stage, capital(job.stage)); // "Waiting", or "Waiting for room on the disk"
      fill(share);
      fill(left, job.queue_position ? `${counted(job.queue_position, "job")} before it` : "Next in the queue");
      return;
    }
    bar.value = job.progress;
    fill(stage, capital(job.stage));
    fill(share, `${Math.floor(100 * job.progress)} %`);
    fill(left, remaining(job.eta_s) || "Time left is not known yet",
      job.attempt > 1 ? ` · ${restartReason(job)}` : "");
    announce(job.progress, `${capital(job.stage)}, ${Math.floor(100 * job.progress)} percent. ${remaining(job.eta_s)}`);
  };
  const silence = () => fill(left, "The service does not answer; it is asked again until it does.");
  return { element, update, silence };
}

/** Why a job that was started before began anew. @param {any} job */
function restartReason(job) {
  return job.losses
    ? `restarted, because its worker was lost${job.losses > 1 ? ` ${job.losses} times` : ""}`
    : "restarted, because the service was restarted";
}
