/** What can be taken away from a finished job. */

import { h } from "../lib/dom.js";
import { bytes } from "../lib/format.js";
import { fileLink } from "../lib/files.js";
import { openTrajectories } from "./trajectories.js";

/**
 * @param {any} job
 * @returns {HTMLElement}
 */
export function downloads(job) {
  const { links } = job;
  const stem = (job.result_name ?? job.source_name).replace(/\.[^.]*$/, "");
  const size = job.result_bytes ? ` (${bytes(job.result_bytes)})` : "";
  return h("div.downloads", { role: "group", "aria-label": "Downloads" },
    job.options?.method === "live" ? null : fileLink({ text: `G-code${size}`, href: links.result, name: job.result_name, main: true, signed: `${links.result}/link` }),
    links.report ? fileLink({ text: "Report", href: links.report, name: `${stem}.report.html`, open: true }) : null,
    links.report_json ? fileLink({ text: "Report (JSON)", href: links.report_json, name: `${stem}.report.json` }) : null,
    links.trajectories ? h("button", { type: "button", onclick: openTrajectories }, "Trajectories (CSV) …") : null);
}
