// The model: orbited, clicked on, and marked with numbered points.
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DoubleSide,
  EdgesGeometry,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  Raycaster,
  SRGBColorSpace,
  Vector2,
  Vector3,
} from "three";
import { Stage } from "../common/stage.js";
import { kindOf } from "./marker.js";
import { Markers } from "./markers.js";

const CLICK_REACH = 4;
const MARKER_REACH = 14;
const HIDDEN_BY = 0.02; // diagonals that a marker may lie behind the surface
const EDGES_UP_TO = 30000;
const FOLD = 30;
const FRONT = new Vector3(0.8, 0.6, -1.4); // ShapeNet's models face -z

export class ModelView {
  /**
   * @param {HTMLElement} host - the element to fill
   * @param {object} handlers - onPick({origin, direction, near}), onSelect(pair)
   */
  constructor(host, handlers) {
    this.handlers = handlers;
    this.stage = new Stage(host, {
      label:
        "The model. Arrow keys turn it, plus and minus zoom, Enter places a point at the middle of the view.",
    });
    this.stage.canvas.setAttribute("role", "application");
    this.markers = new Markers(this.stage);
    this.stage.beforeDraw = () => this.markers.face();
    this.state = null;
    this.raycaster = new Raycaster();
    const { canvas } = this.stage;
    canvas.addEventListener("pointerdown", (event) => {
      this.press = event.button === 0 && event.isPrimary ? { x: event.clientX, y: event.clientY } : null;
    });
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointermove", (event) => this.hover(event));
  }

  /** Fetch the triangles; resolves to what is shown of how many. */
  async load() {
    const response = await fetch("model");
    if (!response.ok) throw new Error(await response.text());
    const buffer = await response.arrayBuffer();
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const corners = 9 * header.shown;
    const start = 4 + length;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(buffer, start, corners), 3));
    geometry.setAttribute(
      "normal",
      new BufferAttribute(new Float32Array(buffer, start + 4 * corners, corners), 3),
    );
    const bytes = new Uint8Array(buffer, start + 8 * corners, 3 * header.shown);
    geometry.setAttribute("color", new BufferAttribute(cornerColors(bytes), 3));
    this.mesh = new Mesh(geometry, new MeshLambertMaterial({ vertexColors: true, side: DoubleSide }));
    this.stage.scene.add(this.mesh);
    if (header.shown <= EDGES_UP_TO) {
      const material = new LineBasicMaterial({ color: 0x10151c, transparent: true, opacity: 0.45 });
      this.stage.scene.add(new LineSegments(new EdgesGeometry(geometry, FOLD), material));
    }
    this.frame();
    return header;
  }

  /** See the whole model, from its front as most models have it. */
  frame() {
    if (this.mesh) this.stage.frame(this.mesh, FRONT);
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
    this.state = state;
    const shown = [];
    for (const point of state.keypoints) {
      if (!point.used) shown.push({ kind: "free", label: "", xyz: point.xyz, keypoint: point.keypoint, name: point.name });
    }
    for (const pair of state.pairs) {
      if (pair.xyz) {
        shown.push({ kind: kindOf(pair, selected), label: String(pair.position), xyz: pair.xyz, pair: pair.pair, name: pair.name });
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

  release(event) {
    const { press } = this;
    this.press = null;
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
    const marker = this.markerAt(place);
    if (marker?.pair !== undefined) {
      this.handlers.onSelect(marker.pair);
    } else if (marker?.suggested) {
      this.handlers.onSuggested();
    } else {
      const { origin, direction } = this.aim(place);
      this.handlers.onPick({
        origin: origin.toArray(),
        direction: direction.toArray(),
        near: marker?.keypoint ?? null,
      });
    }
  }

  /** The ray through a place on the page. */
  aim({ x, y }) {
    const { left, top, width, height } = this.stage.canvas.getBoundingClientRect();
    const place = new Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height);
    this.stage.camera.updateMatrixWorld();
    this.raycaster.setFromCamera(place, this.stage.camera);
    return this.raycaster.ray;
  }

  /** The marker at a place on the page that nothing hides, if any. */
  markerAt(place) {
    const near = this.markers.shown
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
    if (event.buttons) return;
    const marker = this.markerAt({ x: event.clientX, y: event.clientY });
    this.stage.canvas.title = marker?.name ?? "";
    this.stage.canvas.style.cursor = marker ? "pointer" : "crosshair";
  }
}

/** Linear colours of all corners from the triangles' sRGB bytes. */
function cornerColors(bytes) {
  const colors = new Float32Array(3 * bytes.length);
  const linear = Float32Array.from({ length: 256 }, (_, level) =>
    new Color().setRGB(level / 255, 0, 0, SRGBColorSpace).r,
  );
  for (let face = 0; face < bytes.length / 3; face += 1) {
    for (let k = 0; k < 9; k += 1) colors[9 * face + k] = linear[bytes[3 * face + (k % 3)]];
  }
  return colors;
}
