/** Where one looks: the middle of the view in mm, and pixels per mm. Both panes share it. */

const CLOSEST_PX_PER_MM = 400;
const MARGIN_PX = 18;

export class Camera {
  /** @param {[number, number, number, number]} bounds Of all layers, in mm: x0, y0, x1, y1. */
  constructor(bounds) {
    this._bounds = bounds;
    this._width = 1;
    this._height = 1;
    this.x = (bounds[0] + bounds[2]) / 2;
    this.y = (bounds[1] + bounds[3]) / 2;
    this.scale = 1;
    this._isFitted = true;
  }

  /** Whether everything is in view. */
  get isFitted() {
    return this._isFitted;
  }

  /** How much of a pane the bounds need: height by width. */
  get aspect() {
    const [x0, y0, x1, y1] = this._bounds;
    return Math.max(y1 - y0, 1e-3) / Math.max(x1 - x0, 1e-3);
  }

  /** @param {number} width Of a pane, in CSS pixels. @param {number} height */
  resize(width, height) {
    this._width = Math.max(width, 1);
    this._height = Math.max(height, 1);
    if (this._isFitted) this.fit();
  }

  /** Show everything. */
  fit() {
    const [x0, y0, x1, y1] = this._bounds;
    this.x = (x0 + x1) / 2;
    this.y = (y0 + y1) / 2;
    this.scale = this._fitScale();
    this._isFitted = true;
  }

  /**
   * Zoom, keeping the place under a pixel of the pane where it is.
   *
   * @param {number} factor
   * @param {number} [px]
   * @param {number} [py]
   */
  zoom(factor, px = this._width / 2, py = this._height / 2) {
    const [x, y] = this.toWorld(px, py);
    const fit = this._fitScale();
    this.scale = Math.min(Math.max(this.scale * factor, fit), Math.max(CLOSEST_PX_PER_MM, fit));
    if (this.scale <= fit * 1.001) return this.fit();
    this._isFitted = false;
    this.x = x - (px - this._width / 2) / this.scale;
    this.y = y + (py - this._height / 2) / this.scale;
    this._keepInView();
  }

  /** @param {number} dx In pixels: how far the picture goes to the right. @param {number} dy And down. */
  pan(dx, dy) {
    if (this._isFitted) return;
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this._keepInView();
  }

  /** Bring a place into view, if it is not. @param {number} x @param {number} y */
  reveal(x, y) {
    const [px, py] = this.toPane(x, y);
    if (px > 20 && py > 20 && px < this._width - 20 && py < this._height - 20) return;
    this.x = x;
    this.y = y;
    this._isFitted = false;
    this._keepInView();
  }

  /** @param {number} px @param {number} py @returns {[number, number]} */
  toWorld(px, py) {
    return [this.x + (px - this._width / 2) / this.scale, this.y - (py - this._height / 2) / this.scale];
  }

  /** @param {number} x @param {number} y @returns {[number, number]} */
  toPane(x, y) {
    return [this._width / 2 + (x - this.x) * this.scale, this._height / 2 - (y - this.y) * this.scale];
  }

  _fitScale() {
    const [x0, y0, x1, y1] = this._bounds;
    return Math.min((this._width - 2 * MARGIN_PX) / Math.max(x1 - x0, 1e-3),
      (this._height - 2 * MARGIN_PX) / Math.max(y1 - y0, 1e-3));
  }

  _keepInView() {
    const [x0, y0, x1, y1] = this._bounds;
    this.x = Math.min(Math.max(this.x, x0), x1);
    this.y = Math.min(Math.max(this.y, y0), y1);
  }
}
