/**
 * Draws a layer by WebGL (three.js): one instance of a thin rectangle per line. The columns of a
 * tile go to the graphics card as they are; nothing is computed per point here.
 */

import * as THREE from "../vendor/three/three.module.min.js";
import { STEPS, UNKNOWN } from "./colours.js";
import { ERROR_STEP_UM, UNKNOWN_ERROR } from "./tiles.js";

/**
 * @typedef {import("./tiles.js").Tile} Tile
 * @typedef {import("./camera.js").Camera} Camera
 * @typedef {{channel: string, x: number, y: number, width: number, height: number}} Pane In CSS
 *   pixels of the canvas, from its upper left corner.
 */

const VERTEX = `
uniform vec2 centre, halfPane;
uniform float scale, halfWidth, toLevel, unknown;
attribute float x0, y0, x1, y1, error, on;
varying float level, isKnown, size;
varying vec2 local;
void main() {
  vec2 a = (vec2(x0, y0) - centre) * scale, b = (vec2(x1, y1) - centre) * scale;
  vec2 along = b - a;
  size = length(along);
  along = size > 1e-6 ? along / size : vec2(1.0, 0.0);
  // A corner of the rectangle: ends reach over by half a width, where they are rounded.
  local = vec2(mix(-halfWidth, size + halfWidth, position.x), position.y * halfWidth);
  vec2 at = a + along * local.x + vec2(-along.y, along.x) * local.y;
  isKnown = error >= unknown ? 0.0 : 1.0;
  level = clamp(error * toLevel, 0.0, 1.0);
  // Large errors are in front.
  gl_Position = on > 0.5 ? vec4(at / halfPane, 0.9 - 1.8 * level * isKnown, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`;
const FRAGMENT = `
uniform sampler2D map;
uniform vec3 grey;
uniform float halfWidth;
varying float level, isKnown, size;
varying vec2 local;
void main() {
  vec2 fromLine = vec2(local.x - clamp(local.x, 0.0, size), local.y);
  if (halfWidth > 1.5 && dot(fromLine, fromLine) > halfWidth * halfWidth) discard;
  gl_FragColor = vec4(isKnown > 0.5 ? texture2D(map, vec2(level, 0.5)).rgb : grey, 1.0);
}`;

export class WebglRenderer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @throws If the browser has no WebGL.
   */
  constructor(canvas) {
    this._renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this._renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // colours are drawn as they are
    this._renderer.autoClear = false;
    this._renderer.setClearColor(0x000000, 0); // the ground shines through
    this._scene = new THREE.Scene();
    this._eye = new THREE.Camera();
    this._material = new THREE.ShaderMaterial({
      vertexShader: VERTEX, fragmentShader: FRAGMENT, side: THREE.DoubleSide,
      uniforms: {
        centre: { value: new THREE.Vector2() }, halfPane: { value: new THREE.Vector2() }, scale: { value: 1 },
        halfWidth: { value: 1 }, toLevel: { value: 1 }, unknown: { value: UNKNOWN_ERROR },
        map: { value: null }, grey: { value: new THREE.Vector3(...UNKNOWN.map((v) => v / 255)) },
      },
    });
    /** @type {Tile | null} */
    this._tile = null;
    /** @type {Map<string, any>} Geometry by channel. */
    this._meshes = new Map();
    this._height = 0;
  }

  /** For people who ask what draws. */
  get name() {
    return "webgl";
  }

  /** @param {number} width @param {number} height In CSS pixels. */
  resize(width, height) {
    this._renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this._renderer.setSize(width, height, false);
    this._height = height;
  }

  /** @param {Uint8Array} map STEPS colours as RGBA. */
  setColours(map) {
    const uniforms = this._material.uniforms;
    uniforms.map.value?.dispose();
    const texture = new THREE.DataTexture(map, STEPS, 1, THREE.RGBAFormat);
    texture.magFilter = texture.minFilter = THREE.LinearFilter;
    texture.needsUpdate = true;
    uniforms.map.value = texture;
  }

  /**
   * @param {Tile | null} tile
   * @param {Pane[]} panes
   * @param {Camera} camera
   * @param {{scaleUm: number, lineMm: number}} look
   */
  draw(tile, panes, camera, { scaleUm, lineMm }) {
    this._use(tile);
    this._renderer.setScissorTest(false);
    this._renderer.clear();
    if (tile === null) return;
    const uniforms = this._material.uniforms;
    uniforms.centre.value.set(camera.x, camera.y);
    uniforms.scale.value = camera.scale;
    uniforms.halfWidth.value = Math.max(0.6, Math.min(0.5 * lineMm * camera.scale, 12));
    uniforms.toLevel.value = ERROR_STEP_UM / scaleUm;
    this._renderer.setScissorTest(true);
    for (const pane of panes) {
      const mesh = this._mesh(tile, pane.channel);
      uniforms.halfPane.value.set(pane.width / 2, pane.height / 2);
      const below = this._height - pane.y - pane.height;
      this._renderer.setViewport(pane.x, below, pane.width, pane.height);
      this._renderer.setScissor(pane.x, below, pane.width, pane.height);
      this._scene.children = [mesh];
      this._renderer.clearDepth();
      this._renderer.render(this._scene, this._eye);
    }
  }

  /** Give back what the graphics card holds. */
  dispose() {
    this._use(null);
    this._material.uniforms.map.value?.dispose();
    this._material.dispose();
    this._renderer.dispose();
    this._renderer.forceContextLoss();
  }

  /** @param {Tile | null} tile */
  _use(tile) {
    if (tile === this._tile) return;
    for (const mesh of this._meshes.values()) mesh.geometry.dispose();
    this._meshes.clear();
    this._tile = tile;
  }

  /** @param {Tile} tile @param {string} channel */
  _mesh(tile, channel) {
    const made = this._meshes.get(channel);
    if (made) return made;
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute([0, -1, 0, 1, -1, 0, 1, 1, 0, 0, 1, 0], 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    const lines = Math.max(tile.points - 1, 0);
    for (const [name, column] of Object.entries({
      x0: tile.x.subarray(0, lines), x1: tile.x.subarray(1), y0: tile.y.subarray(0, lines), y1: tile.y.subarray(1),
      error: tile.errors[channel].subarray(1), on: tile.on.subarray(1),
    })) {
      geometry.setAttribute(name, new THREE.InstancedBufferAttribute(column, 1));
    }
    geometry.instanceCount = lines;
    const mesh = new THREE.Mesh(geometry, this._material);
    mesh.frustumCulled = false;
    this._meshes.set(channel, mesh);
    return mesh;
  }
}
