// A three.js canvas that can be orbited: what every 3D view of the pages stands on.
import {
  AmbientLight,
  Box3,
  Color,
  DirectionalLight,
  PerspectiveCamera,
  Scene,
  Sphere,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

/**
 * A scene drawn only when something has changed. Its axes are those of the model: y up, or another.
 *
 * @param {HTMLElement} host - the element to fill; it needs a size of its own
 * @param {object} options
 * @param {string} options.label - what a screen reader says of the canvas
 * @param {boolean} options.zoomToCursor - zoom at the pointer, not at the middle
 */
export class Stage {
  constructor(host, { label, zoomToCursor = false }) {
    this.host = host;
    this.zoomToCursor = zoomToCursor;
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(40, 1, 0.01, 100);
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.canvas = this.renderer.domElement;
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", label);
    host.append(this.canvas);

    this.scene.add(new AmbientLight(new Color(1, 1, 1), 1.6));
    const sun = new DirectionalLight(new Color(1, 1, 1), 2.2);
    sun.position.set(0.6, 1, 0.8);
    this.camera.add(sun);
    this.scene.add(this.camera);

    this.orbit();
    this.canvas.addEventListener("keydown", (event) => this.steer(event));
    new ResizeObserver(() => this.resize()).observe(host);
    this.resize();
  }

  /** Orbit about the direction that points up on the screen; controls keep the one they began with. */
  orbit(up = this.camera.up) {
    if (this.controls && this.camera.up.equals(up)) return;
    this.controls?.dispose();
    this.camera.up.copy(up);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.zoomToCursor = this.zoomToCursor;
    this.controls.addEventListener("change", () => this.invalidate());
  }

  /** Place the camera so that an object fills the view, seen along a direction. */
  frame(object, direction = new Vector3(1, 0.6, 1.4)) {
    const sphere = new Box3().setFromObject(object).getBoundingSphere(new Sphere());
    const radius = Math.max(sphere.radius, 1e-9);
    const half = (this.camera.fov * Math.PI) / 360;
    const distance = (1.1 * radius) / Math.sin(Math.min(half, Math.atan(Math.tan(half) * this.camera.aspect)));
    this.camera.position.copy(sphere.center).addScaledVector(direction.clone().normalize(), distance);
    this.camera.near = distance / 1000;
    this.camera.far = distance * 100;
    this.camera.updateProjectionMatrix();
    this.controls.target.copy(sphere.center);
    this.controls.update();
    this.invalidate();
  }

  /** Orbit by the arrow keys, come nearer and go back by plus and minus. */
  steer(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = Math.PI / 24;
    const nearer = 0.9;
    const move = {
      ArrowLeft: () => this.controls.rotateLeft(step),
      ArrowRight: () => this.controls.rotateLeft(-step),
      ArrowUp: () => this.controls.rotateUp(step),
      ArrowDown: () => this.controls.rotateUp(-step),
      "+": () => this.controls.dollyIn(nearer),
      "=": () => this.controls.dollyIn(nearer),
      "-": () => this.controls.dollyOut(nearer),
    }[event.key];
    if (!move) return;
    move();
    event.preventDefault();
    event.stopPropagation();
  }

  /** Ask for a redraw with the next frame. */
  invalidate() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      this.beforeDraw?.();
      this.renderer.render(this.scene, this.camera);
      this.afterDraw?.();
    });
  }

  resize() {
    const { clientWidth, clientHeight } = this.host;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.invalidate();
  }
}
