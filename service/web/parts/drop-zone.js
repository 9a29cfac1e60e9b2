/** A place to drop files on, or to choose them by. */

import { fill, h, uniqueId } from "../lib/dom.js";
import { bytes } from "../lib/format.js";

/**
 * @param {{label: string, hint: string, multiple?: boolean,
 *   onChoose: (files: File[]) => void}} options
 * @returns {HTMLElement}
 */
export function dropZone({ label, hint, multiple = false, onChoose }) {
  const id = uniqueId("file");
  // No `accept`: phones know no type for .gcode or .cfg, and would let nobody choose such a file.
  const input = h("input", { type: "file", id, multiple, "aria-describedby": `${id}-hint` });
  const name = h("strong", null, label);
  const more = h("small", { id: `${id}-hint` }, hint);
  const zone = h("label.drop", { for: id }, input,
    h("span.arrow", { "aria-hidden": "true" }), name, more);
  const take = (/** @type {FileList | null | undefined} */ list) => {
    const given = [...(list ?? [])];
    const files = multiple ? given : given.slice(0, 1);
    if (files.length === 0) return;
    const change = given.length > files.length ? `one file at a time: ${given.length - 1} left out` : "choose another";
    zone.classList.add("chosen");
    fill(name, files.length === 1 ? files[0].name : `${files.length} files`);
    const total = files.reduce((sum, file) => sum + file.size, 0);
    fill(more, `${bytes(total)}${files.length > 1 ? `: ${files.map((f) => f.name).join(", ")}` : ` · ${change}`}`);
    onChoose(files);
  };
  // The same file chosen again, as after slicing anew, is a change too.
  input.addEventListener("click", () => {
    input.value = "";
  });
  input.addEventListener("change", () => take(input.files));
  // Entering a child fires `dragleave` on the zone, so that levels are counted.
  let depth = 0;
  zone.addEventListener("dragenter", (/** @type {DragEvent} */ event) => {
    event.preventDefault();
    depth += 1;
    zone.classList.add("over");
  });
  zone.addEventListener("dragover", (/** @type {DragEvent} */ event) => event.preventDefault());
  zone.addEventListener("dragleave", () => {
    depth = Math.max(0, depth - 1);
    zone.classList.toggle("over", depth > 0);
  });
  zone.addEventListener("drop", (/** @type {DragEvent} */ event) => {
    event.preventDefault();
    depth = 0;
    zone.classList.remove("over");
    take(event.dataTransfer?.files);
  });
  return zone;
}
