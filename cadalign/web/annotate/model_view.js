// The model: orbited, clicked on, and marked with numbered points.
import {
  AxesHelper,
  BufferAttribute,
  BufferGeometry,
  DoubleSide,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  Raycaster,
  Vector2,
  Vector3,
} from "three";
import { Stage } from "../common/stage.js";
import { fetched } from "./api.js";
import { kindOf } from "./drawing.js";
import { Markers } from "./markers.js";

const CLICK_REACH = 4; // [px]
const MARKER_REACH = 14; // [px]
const HIDDEN_BY = 0.02; // that a marker may lie behind the surface [diagonals]
const BEYOND = 0.12; // how far the axes stick out of the model [diagonals]
const FRONT = [0.8, 0.6, -1.4]; // ShapeNet's models face -z
// Directions at models of which y points up, at those of another up axis, which face -y.
const STANDING = { x: (x, y, z) => [y, z, x], y: (x, y, z) => [x, y, z], z: (x, y, z) => [-x, z, y] };

export class ModelView {
  /**
   * @param {HTMLElement} host - the element to fill
   * @param {object} handlers - onPick({ origin, direction, near }), onSelect(pair)
   */
  constructor(host, handlers) {
    this.handlers = handlers;
    this.stage = new Stage(host, {
      label: "The model. Arrow keys turn it, plus and minus zoom, Enter places a point at the middle of the view.",
      zoomToCursor: true,
    });
    this.canvas = this.stage.canvas;
    this.canvas.setAttribute("role", "application");
    this.markers = new Markers(this.stage);
    this.stage.beforeDraw = () => this.markers.face();
    this.state = null;
    this.wanted = null; // the model that is or will be shown
    this.mesh = null; // until it is there, nothing can be clicked on
    this.upAxis = "y";
    this.raycaster = new Raycaster();
    this.canvas.addEventListener("pointerdown", (event) => this.down(event));
    this.canvas.addEventListener("pointerup", (event) => this.up(event));
    this.canvas.addEventListener("pointermove", (event) => this.hover(event));
  }

  /** Fetch and show the model of a photo, unless it is shown; after a failure, the next call tries again. */
  async load(number, { key, is_skeleton: isSkeleton }) {
    if (key === this.wanted?.key) return;
    const wanted = (this.wanted = { key });
    this.clear();
    let buffer;
    try {
      buffer = await (await fetched(`model/${number}?${key}`)).arrayBuffer();
    } catch (error) {
      if (wanted === this.wanted) this.wanted = null;
      throw error;
    }
    if (wanted !== this.wanted) return; // the page has gone on to another model
    this.isSkeleton = isSkeleton;
    this.wasAligned = false;
    const [faces, edges] = new Uint32Array(buffer, 0, 2);
    let offset = 8;
    const take = (vertices) => {
      const values = new Float32Array(buffer, offset, 3 * vertices);
      offset += values.byteLength;
      return new BufferAttribute(values, 3);
    };
    const surface = new BufferGeometry();
    for (const name of ["position", "normal", "color"]) surface.setAttribute(name, take(3 * faces));
    const creases = new BufferGeometry();
    creases.setAttribute("position", take(2 * edges));
    this.mesh = new Mesh(
      surface,
      // The offset keeps lines on the surface from being cut.
      new MeshLambertMaterial({ vertexColors: true, side: DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 }),
    );
    surface.computeBoundingBox(); // about the origin
    this.ends = surface.boundingBox.max.clone().addScalar(BEYOND);
    const axes = new AxesHelper(1);
    axes.scale.copy(this.ends);
    const grey = new LineBasicMaterial({ color: 0x7d8794, transparent: true, opacity: 0.4 });
    this.group = new Group().add(this.mesh, new LineSegments(creases, grey), axes);
    this.stage.scene.add(this.group);
    this.frame();
    if (this.state) this.show(this.state, this.selected);
  }

  clear() {
    for (const { geometry, material } of this.group?.children ?? []) {
      geometry.dispose();
      material.dispose();
    }
    this.group?.removeFromParent();
    this.mesh = this.group = null;
    this.stage.invalidate();
  }

  /** See the whole model from a direction, given for one of which y points up. */
  frame(direction = FRONT) {
    if (!this.mesh) return;
    const standing = (xyz) => new Vector3(...STANDING[this.upAxis](...xyz));
    this.stage.orbit(standing([0, 1, 0]));
    this.stage.frame(this.mesh, standing(direction));
  }

  /** Look at the model from where the photo was taken. */
  frameAsPhoto() {
    const eye = this.state?.alignment.eye;
    if (eye && this.mesh) this.stage.frame(this.mesh, new Vector3(...eye));
  }

  zoom(factor) {
    const { camera, controls } = this.stage;
    camera.position.sub(controls.target).divideScalar(factor).add(controls.target);
    controls.update();
    this.stage.invalidate();
  }

  show(state, selected) {
    Object.assign(this, { state, selected });
    if (this.upAxis !== state.image.up_axis) {
      this.upAxis = state.image.up_axis;
      this.frame();
    }
    const { keypoints, pairs, alignment, model } = state;
    const isAligned = alignment.status === "done";
    if (this.isSkeleton && isAligned && !this.wasAligned) this.frameAsPhoto();
    this.wasAligned = isAligned;
    const end = (label) => new Vector3().setComponent("xyz".indexOf(label), this.ends[label]).toArray();
    const axes = this.mesh ? [..."xyz"].map((label) => ({ kind: "axis", label, xyz: end(label), fixed: true })) : [];
    const free = keypoints.filter(({ used }) => !used).map((point) => ({
      kind: point.keypoint === model.proposed ? "proposed" : "free", label: "", ...point,
    }));
    const placed = pairs.filter(({ xyz }) => xyz).map((pair) => ({
      kind: kindOf(pair, selected), label: String(pair.pair), xyz: pair.xyz, pair: pair.pair, name: pair.name,
    }));
    if (!this.markers.show([...axes, ...free, ...placed])) return;
    // Not in the same frame as the photo, which is what one looks at.
    requestAnimationFrame(() => requestAnimationFrame(() => this.stage.invalidate()));
  }

  /** Place on the page of a point of the model. */
  toPage(xyz) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    this.stage.camera.updateMatrixWorld(); // it may have moved since it was last drawn
    const point = new Vector3(...xyz).project(this.stage.camera);
    return { x: left + ((point.x + 1) / 2) * width, y: top + ((1 - point.y) / 2) * height };
  }

  down(event) {
    const isClick = event.button === 0 && event.isPrimary;
    this.press = isClick ? { x: event.clientX, y: event.clientY } : null;
  }

  up(event) {
    const { press } = this;
    this.press = null;
    if (!press || Math.hypot(event.clientX - press.x, event.clientY - press.y) > CLICK_REACH) return;
    this.pick(press);
  }

  /** Pick at the middle of the view. */
  pickMiddle() {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    this.pick({ x: left + width / 2, y: top + height / 2 });
  }

  /** Pick at a place on the page: a marker, or the surface by a ray and the unused keypoint near it. */
  pick(place) {
    const marker = this.markerAt(place);
    if (marker?.pair !== undefined) return this.handlers.onSelect(marker.pair);
    const { origin, direction } = this.aim(place);
    const near = marker?.keypoint ?? null;
    return this.handlers.onPick({ origin: origin.toArray(), direction: direction.toArray(), near });
  }

  /** The ray through a place on the page. */
  aim({ x, y }) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const place = new Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height);
    this.stage.camera.updateMatrixWorld();
    this.raycaster.setFromCamera(place, this.stage.camera);
    return this.raycaster.ray;
  }

  /** The nearest marker at a place on the page that nothing hides. */
  markerAt(place) {
    const gap = ({ xyz }) => {
      const at = this.toPage(xyz);
      return Math.hypot(at.x - place.x, at.y - place.y);
    };
    return this.markers.shown
      .filter((marker) => !marker.fixed && gap(marker) < MARKER_REACH)
      .sort((a, b) => gap(a) - gap(b))
      .find(({ xyz }) => !this.isHidden(xyz));
  }

  isHidden(xyz) {
    if (!this.mesh || this.isSkeleton) return false;
    const { position } = this.stage.camera;
    const sight = new Vector3(...xyz).sub(position);
    const distance = sight.length();
    this.raycaster.set(position, sight.normalize());
    const [hit] = this.raycaster.intersectObject(this.mesh);
    return hit !== undefined && hit.distance < distance - HIDDEN_BY;
  }

  hover(event) {
    if (event.buttons) return;
    const marker = this.markerAt({ x: event.clientX, y: event.clientY });
    this.canvas.title = marker?.name ?? "";
    this.canvas.style.cursor = marker ? "pointer" : "crosshair";
  }
}
