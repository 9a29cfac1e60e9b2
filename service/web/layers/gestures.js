/** Wheel, pinch, drag, hover, tap and keys over the view, told in the view's own terms. */

const STEP_PX = 60;
const ZOOM = 1.35;
const TAP_PX = 6;

/**
 * @typedef {object} Handlers
 * @property {(factor: number, px?: number, py?: number) => boolean} zoom Whether anything changed.
 * @property {(dx: number, dy: number) => void} pan
 * @property {() => void} fit
 * @property {(px: number, py: number) => void} point
 * @property {() => void} leave
 * @property {(step: number) => void} layer
 * @property {(step: number) => void} walk
 * @property {() => boolean} isFitted
 */

/**
 * @param {HTMLElement} stage
 * @param {Handlers} on
 */
export function wireGestures(stage, on) {
  /** @type {Map<number, {x: number, y: number}>} */
  const down = new Map();
  let moved = 0;
  const place = (/** @type {MouseEvent} */ event) => {
    const frame = stage.getBoundingClientRect();
    return { x: event.clientX - frame.left, y: event.clientY - frame.top };
  };
  const allow = () => {
    // While everything is in view a finger scrolls the page; once zoomed it moves the picture.
    stage.style.touchAction = on.isFitted() ? "pan-y" : "none";
  };

  stage.addEventListener("wheel", (event) => {
    const at = place(event);
    const lines = event.deltaMode === 1 ? 16 : 1;
    const factor = Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0015));
    // Zooming out of what is all in view scrolls the page on.
    if (on.zoom(factor, at.x, at.y)) event.preventDefault();
    allow();
  }, { passive: false });

  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || /** @type {Element} */ (event.target).closest("button")) return;
    if (down.size === 0) moved = 0;
    down.set(event.pointerId, place(event));
    // A finger may still scroll the page; a mouse that drags shall not be lost at the edge.
    if (event.pointerType === "mouse") stage.setPointerCapture(event.pointerId);
  });
  stage.addEventListener("pointermove", (event) => {
    const at = place(event);
    const last = down.get(event.pointerId);
    if (last === undefined) {
      if (event.pointerType !== "touch") on.point(at.x, at.y);
      return;
    }
    const others = [...down].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
    if (others.length) pinch(others[0], last, at, on);
    else on.pan(at.x - last.x, at.y - last.y);
    moved += Math.hypot(at.x - last.x, at.y - last.y);
    down.set(event.pointerId, at);
    allow();
  });
  for (const end of /** @type {const} */ (["pointerup", "pointercancel"])) {
    stage.addEventListener(end, (event) => {
      if (!down.delete(event.pointerId)) return;
      const at = place(event);
      if (end === "pointerup" && down.size === 0 && moved < TAP_PX) on.point(at.x, at.y);
    });
  }
  stage.addEventListener("pointerleave", (event) => {
    if (event.pointerType !== "touch" && down.size === 0) on.leave();
  });
  stage.addEventListener("dblclick", (event) => {
    const at = place(event);
    on.zoom(ZOOM * ZOOM, at.x, at.y);
    allow();
  });
  stage.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target !== stage) return;
    const act = {
      ArrowLeft: () => on.pan(STEP_PX, 0), ArrowRight: () => on.pan(-STEP_PX, 0),
      ArrowUp: () => on.pan(0, STEP_PX), ArrowDown: () => on.pan(0, -STEP_PX),
      "+": () => on.zoom(ZOOM), "=": () => on.zoom(ZOOM), "-": () => on.zoom(1 / ZOOM), 0: () => on.fit(),
      PageUp: () => on.layer(1), PageDown: () => on.layer(-1), "]": () => on.layer(1), "[": () => on.layer(-1),
      ".": () => on.walk(1), ",": () => on.walk(-1), Escape: () => on.leave(),
    }[event.key];
    if (act === undefined) return;
    event.preventDefault();
    act();
    allow();
  });
  allow();
}

/** Keep both fingers where they are on the picture. */
function pinch(/** @type {any} */ other, /** @type {any} */ last, /** @type {any} */ at, /** @type {Handlers} */ on) {
  const before = Math.hypot(last.x - other.x, last.y - other.y);
  const after = Math.hypot(at.x - other.x, at.y - other.y);
  on.pan((at.x - last.x) / 2, (at.y - last.y) / 2);
  if (before > 1) on.zoom(after / before, (at.x + other.x) / 2, (at.y + other.y) / 2);
}
