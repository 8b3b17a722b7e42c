// The model drawn over the photo in the estimated pose, shaded as on the right.
import { Matrix4, PerspectiveCamera, Scene, WebGLRenderer } from "three";

const NEAR = 1e-3; // over the distance
const FAR = 1e3;

export class ShadedOverlay {
  /** @param {import("three").Group} group - the model to draw, in the page's coordinates */
  constructor(group) {
    this.model = group.clone();
    this.model.matrixAutoUpdate = false;
    this.scene = new Scene();
    this.scene.add(this.model);
    this.camera = new PerspectiveCamera();
    this.camera.matrixAutoUpdate = false;
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(1);
  }

  /**
   * A picture of the model; the same canvas every time.
   *
   * @param {object} seen - of the state's alignment: camera_from_page (rows of 4), intrinsics
   * @param {object} view - scale, offset, width and height of the photo's view
   */
  draw({ camera_from_page: rows, intrinsics }, { scale, offset, width, height }) {
    const { fx, fy, cx, cy } = intrinsics;
    this.renderer.setSize(width, height, false);
    this.model.matrix.set(...rows);
    this.model.matrixWorldNeedsUpdate = true;
    const distance = Math.hypot(rows[3], rows[7], rows[11]);
    const [near, far] = [NEAR * distance, FAR * distance];
    const [left, top] = [cx * scale + offset.x, cy * scale + offset.y];
    // OpenGL looks along -z with y up: the second and third rows of the pose change their sign.
    this.camera.matrixWorldInverse.makeScale(1, -1, -1);
    this.camera.matrixWorld.copy(this.camera.matrixWorldInverse).invert();
    this.camera.matrix.copy(this.camera.matrixWorld);
    this.camera.projectionMatrix.copy(
      new Matrix4().set(
        (2 * fx * scale) / width, 0, 1 - (2 * left) / width, 0,
        0, (2 * fy * scale) / height, (2 * top) / height - 1, 0,
        0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
        0, 0, -1, 0,
      ),
    );
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
    this.renderer.render(this.scene, this.camera);
    return this.renderer.domElement;
  }
}
