// The model: orbited, clicked on, and marked with numbered points.
import { Box3, Raycaster, Vector2, Vector3 } from "three";
import { Stage } from "../common/stage.js";
import { Loupe, renderLoupe } from "./loupe.js";
import { kindOf } from "./marker.js";
import { Markers } from "./markers.js";
import { fetchModel, makeAxes } from "./model_mesh.js";
import { ASIDE, disposeResult, makeResult } from "./result_view.js";

const CLICK_REACH = 4;
const MARKER_REACH = 14;
const HIDDEN_BY = 0.02; // diagonals that a marker may lie behind the surface
const FRONT = [0.8, 0.6, -1.4]; // ShapeNet's models face -z
// Directions at models of which y points up, at those of another up axis, which face -y.
const STANDING = { x: (x, y, z) => [y, z, x], y: (x, y, z) => [x, y, z], z: (x, y, z) => [-x, z, y] };

export class ModelView {
  /**
   * @param {HTMLElement} host - the element to fill
   * @param {object} handlers - onPick(aim), onRepick(pair, aim), onSelect(pair),
   *   onSuggested(), where an aim has origin, direction and near
   */
  constructor(host, handlers) {
    this.handlers = handlers;
    this.stage = new Stage(host, {
      label:
        "The model. Arrow keys turn it, plus and minus zoom, Enter places a point at the middle of the view.",
      zoomToCursor: true,
    });
    this.stage.canvas.setAttribute("role", "application");
    this.markers = new Markers(this.stage);
    this.loupe = new Loupe(host);
    this.stage.beforeDraw = () => this.markers.face();
    this.stage.afterDraw = () => {
      const loupe = this.loupe.place();
      if (loupe) renderLoupe(this.stage, this.markers.group, loupe);
    };
    this.state = null;
    this.mesh = null; // until it is there, nothing can be clicked on
    this.upAxis = "y";
    this.raycaster = new Raycaster();
    const { canvas } = this.stage;
    // Before the controls, which would turn the model while a point is dragged.
    host.addEventListener("pointerdown", (event) => this.down(event), { capture: true });
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerleave", () => this.point(null));
    canvas.addEventListener("pointercancel", () => this.drop());
  }

  /** Fetch and show the model; resolves to what is shown of how many faces. */
  async load() {
    const { header, mesh, group } = await fetchModel();
    this.mesh = mesh;
    this.group = group;
    this.axes = makeAxes(new Box3().setFromObject(mesh));
    this.stage.scene.add(group, this.axes);
    this.frame();
    return header;
  }

  /** Show the aligned model before the photo in place of the model to click on, or no more. */
  showResult(on, picture) {
    const { alignment, image } = this.state ?? {};
    const isThere = on && this.mesh && alignment?.status === "done" && alignment.camera_from_page !== null;
    if (this.result) {
      this.stage.scene.remove(this.result);
      disposeResult(this.result);
    }
    const wasShown = Boolean(this.result);
    this.result = isThere ? makeResult(this.group, alignment, image, picture) : null;
    if (this.result) this.stage.scene.add(this.result);
    if (this.mesh) this.group.visible = this.axes.visible = this.markers.group.visible = !this.result;
    if (Boolean(this.result) !== wasShown) this.frame();
    this.stage.invalidate();
    return Boolean(this.result);
  }

  /** See the whole model, from its usual front, or the whole result. */
  frame() {
    this.stage.orbit(this.result ? new Vector3(0, 1, 0) : this.standing(0, 1, 0));
    if (this.result) this.stage.frame(this.result, ASIDE);
    else this.frameFrom(FRONT);
  }

  /** Look at the model from where the photo was taken. */
  frameAsPhoto() {
    const eye = this.state?.alignment.eye;
    if (eye && !this.result && this.mesh) this.stage.frame(this.mesh, new Vector3(...eye));
  }

  /** Look at the model from a direction, given for one of which y points up. */
  frameFrom(direction) {
    if (this.mesh && !this.result) this.stage.frame(this.mesh, this.standing(...direction));
  }

  /** A direction at the model, given for one of which y points up. */
  standing(x, y, z) {
    return new Vector3(...STANDING[this.upAxis](x, y, z));
  }

  zoom(factor) {
    const { camera, controls } = this.stage;
    camera.position.sub(controls.target).divideScalar(factor).add(controls.target);
    controls.update();
    this.stage.invalidate();
  }

  show(state, selected) {
    this.state = state;
    if (this.upAxis !== state.image.up_axis) {
      this.upAxis = state.image.up_axis;
      this.frame();
    }
    const shown = [];
    for (const point of state.keypoints) {
      if (!point.used) shown.push({ kind: "free", label: "", xyz: point.xyz, keypoint: point.keypoint, name: point.name });
    }
    for (const pair of state.pairs) {
      if (pair.xyz) {
        shown.push({ kind: kindOf(pair, selected), label: String(pair.pair), xyz: pair.xyz, pair: pair.pair, name: pair.name });
      }
    }
    const { suggestion } = state;
    if (suggestion) shown.push({ kind: "suggested", label: "", xyz: suggestion.xyz, keypoint: suggestion.keypoint, suggested: true, name: "suggested next" });
    if (!this.markers.show(shown)) return;
    // Not in the same frame as the photo, which is what one looks at.
    requestAnimationFrame(() => requestAnimationFrame(() => this.stage.invalidate()));
  }

  /** Place on the page of a point of the model. */
  toPage(xyz) {
    const { left, top, width, height } = this.stage.canvas.getBoundingClientRect();
    this.stage.camera.updateMatrixWorld(); // it may have moved since it was last drawn
    const point = new Vector3(...xyz).project(this.stage.camera);
    return { x: left + ((point.x + 1) / 2) * width, y: top + ((1 - point.y) / 2) * height };
  }

  down(event) {
    if (event.button !== 0 || !event.isPrimary || event.target !== this.stage.canvas) {
      this.drop();
      return;
    }
    if (this.result) return;
    const place = { x: event.clientX, y: event.clientY };
    const pair = this.markerAt(place)?.pair;
    this.press = { ...place, pair, moved: false };
    this.stage.controls.enabled = pair === undefined;
    if (pair !== undefined) this.stage.canvas.setPointerCapture(event.pointerId);
  }

  /** End a drag without a change. */
  drop() {
    this.press = null;
    this.stage.controls.enabled = true;
    this.markers.moveTo(undefined, null);
  }

  move(event) {
    const { left, top } = this.stage.canvas.getBoundingClientRect();
    this.point({ x: event.clientX - left, y: event.clientY - top });
    const { press } = this;
    if (press?.pair === undefined) {
      this.hover(event);
      return;
    }
    const place = { x: event.clientX, y: event.clientY };
    press.moved ||= Math.hypot(place.x - press.x, place.y - press.y) > CLICK_REACH;
    if (!press.moved || !this.mesh) return;
    this.aim(place);
    const [hit] = this.raycaster.intersectObject(this.mesh);
    if (!hit) return;
    this.markers.moveTo(press.pair, hit.point.toArray());
    this.stage.invalidate();
  }

  /** Tell the loupe where the pointer is in the view. */
  point(place) {
    this.loupe.pointer = place;
    if (this.loupe.on) this.stage.invalidate();
  }

  release(event) {
    const { press } = this;
    this.press = null;
    this.stage.controls.enabled = true;
    if (press?.pair !== undefined && press.moved) {
      this.handlers.onRepick(press.pair, this.target({ x: event.clientX, y: event.clientY }, press.pair));
      return;
    }
    if (!press || Math.hypot(event.clientX - press.x, event.clientY - press.y) > CLICK_REACH) return;
    this.pick({ x: event.clientX, y: event.clientY });
  }

  /** Pick at the middle of the view. */
  pickMiddle() {
    const { left, top, width, height } = this.stage.canvas.getBoundingClientRect();
    this.pick({ x: left + width / 2, y: top + height / 2 });
  }

  /** Pick at a place on the page. */
  pick(place) {
    if (this.result) return;
    const marker = this.markerAt(place);
    if (marker?.pair !== undefined) {
      this.handlers.onSelect(marker.pair);
    } else if (marker?.suggested) {
      this.handlers.onSuggested();
    } else {
      this.handlers.onPick(this.target(place));
    }
  }

  /** The ray through a place on the page, and the unused keypoint near it. */
  target(place, dragged) {
    const marker = this.markerAt(place, dragged);
    const { origin, direction } = this.aim(place);
    return {
      origin: origin.toArray(),
      direction: direction.toArray(),
      near: marker?.pair === undefined ? (marker?.keypoint ?? null) : null,
    };
  }

  /** The tangent of the angle that some pixels at the middle of the view make. */
  tangent(pixels) {
    const { camera, canvas } = this.stage;
    return (pixels * 2 * Math.tan((camera.fov * Math.PI) / 360)) / Math.max(canvas.clientHeight, 1);
  }

  /** The ray through a place on the page. */
  aim({ x, y }) {
    const { left, top, width, height } = this.stage.canvas.getBoundingClientRect();
    const place = new Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height);
    this.stage.camera.updateMatrixWorld();
    this.raycaster.setFromCamera(place, this.stage.camera);
    return this.raycaster.ray;
  }

  /** The marker at a place on the page that nothing hides, but for that of a dragged pair, if any. */
  markerAt(place, dragged) {
    const near = this.markers.shown
      .filter((marker) => dragged === undefined || marker.pair !== dragged)
      .map((marker) => ({ marker, at: this.toPage(marker.xyz) }))
      .map(({ marker, at }) => ({ marker, gap: Math.hypot(at.x - place.x, at.y - place.y) }))
      .filter(({ gap }) => gap < MARKER_REACH)
      .sort((a, b) => a.gap - b.gap);
    const found = near.find(({ marker }) => !this.isHidden(marker.xyz));
    return found?.marker ?? null;
  }

  isHidden(xyz) {
    if (!this.mesh) return false;
    const { camera } = this.stage;
    const point = new Vector3(...xyz);
    const sight = point.clone().sub(camera.position);
    const distance = sight.length();
    this.raycaster.set(camera.position, sight.normalize());
    const [hit] = this.raycaster.intersectObject(this.mesh);
    return hit !== undefined && hit.distance < distance - HIDDEN_BY;
  }

  hover(event) {
    if (event.buttons || this.result) return;
    const marker = this.markerAt({ x: event.clientX, y: event.clientY });
    this.stage.canvas.title = marker?.name ?? "";
    this.stage.canvas.style.cursor = marker ? "pointer" : "crosshair";
  }
}
