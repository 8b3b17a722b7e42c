// The true and the predicted model in one scene, in the upright axes of the true one.
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DoubleSide,
  Group,
  Matrix4,
  Mesh,
  MeshLambertMaterial,
  Points,
  PointsMaterial,
  Vector3,
} from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { themeColor } from "../common/colors.js";
import { Stage } from "../common/stage.js";
import { BOX_EDGES, anchorOf, cornersOf, matrixOf, shapeOf } from "./pose.js";

const FRUSTUM = 0.35; // size of the camera, relative to its distance

/** Views of a scene, with their labels. */
export const VIEWS = [
  ["object", "The object"], ["picture", "As in the picture"], ["all", "With the camera"],
];

export class Scene3D {
  /** Throws without WebGL. */
  constructor(host) {
    this.stage = new Stage(host, {
      label: "3D view of the predicted and the true model; arrow keys turn it",
    });
    this.content = new Group();
    this.stage.scene.add(this.content);
  }

  /**
   * Show an exhibit.
   *
   * @param {object} exhibit
   * @param {object} options
   * @param {object|null} options.estimate - the pose of the prediction
   * @param {object|null} options.mesh - the unpacked model, before its stretch
   * @param {Set<string>} options.layers - keys of the overlay's `LAYERS`
   * @param {boolean} options.stay - whether to keep the view
   */
  show(exhibit, { estimate, mesh, layers, stay }) {
    this.clear();
    const anchor = exhibit.gt ?? estimate;
    if (!anchor) return this.stage.invalidate();
    this.world = matrix4(anchorOf(anchor));
    this.solids = new Group();
    if (exhibit.gt && layers.has("g")) this.addModel(exhibit, exhibit.gt, "gt", mesh, layers);
    if (estimate && layers.has("p")) this.addModel(exhibit, estimate, "est", mesh, layers);
    this.eye = new Group();
    this.addCamera(exhibit.camera, anchor);
    this.content.add(this.solids, this.eye);
    // Framing uses the objects' world matrices, before the first drawing.
    this.content.updateMatrixWorld(true);
    this.stage.resize();
    if (!stay || !this.viewed) this.view("object");
    this.stage.invalidate();
  }

  addModel(exhibit, pose, kind, mesh, layers) {
    const color = themeColor(kind);
    const matrix = this.world.clone().multiply(matrix4(matrixOf(pose)));
    if (mesh) {
      const { points, edges, layer } = mesh.wire;
      const shaped = shapeOf(exhibit, pose, points);
      const solid = new Mesh(geometryOf(shaped, mesh.faces), surface(color, kind));
      // The true model is drawn over the predicted one, so both are visible where they agree.
      solid.renderOrder = kind === "gt" ? 2 : 1;
      this.solids.add(placed(solid, matrix));
      if (layers.has(layer)) {
        this.solids.add(placed(segments(shaped, edges, color, 1), matrix));
      }
    }
    if (exhibit.bounds) {
      this.solids.add(placed(segments(cornersOf(exhibit.bounds), BOX_EDGES, color, 2.5), matrix));
    }
    if (layers.has("k") && exhibit.points_3d?.length) {
      const geometry = new BufferGeometry();
      geometry.setAttribute(
        "position",
        new BufferAttribute(Float32Array.from((pose.warp?.to ?? exhibit.points_3d).flat()), 3),
      );
      const material = new PointsMaterial({
        color,
        size: 8,
        sizeAttenuation: false,
        depthTest: false,
      });
      const points = placed(new Points(geometry, material), matrix);
      points.renderOrder = 3;
      this.solids.add(points);
    }
  }

  /** The camera as a pyramid, with a flag on its upper edge. */
  addCamera({ width, height, fx, fy, cx, cy }, anchor) {
    const depth = FRUSTUM * Math.hypot(...anchor.translation);
    const at = (u, v) => [((u - cx) * depth) / fx, ((v - cy) * depth) / fy, depth];
    const [right, bottom] = [width - 0.5, height - 0.5];
    const points = [
      [0, 0, 0],
      at(-0.5, -0.5),
      at(right, -0.5),
      at(right, bottom),
      at(-0.5, bottom),
      at(width / 2, -0.15 * height),
    ];
    const edges = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [1, 5], [5, 2]];
    this.eye.add(placed(segments(points, edges, themeColor("accent"), 2), this.world.clone()));
    this.eyeAt = new Vector3().applyMatrix4(this.world);
    this.eyeUp = new Vector3(0, -1, 0).transformDirection(this.world);
  }

  /** Look at the object from beside the camera, from the camera, or at both. */
  view(way) {
    this.viewed = true;
    const { camera, controls } = this.stage;
    const from = this.eyeAt.clone();
    if (way === "all") {
      this.stage.frame(this.content, new Vector3(from.z, 0.35 * from.length(), -from.x));
    } else if (way === "picture") {
      this.stage.frame(this.solids, from);
    } else {
      const aside = from.clone().applyAxisAngle(new Vector3(0, 1, 0), -0.6);
      this.stage.frame(this.solids, aside.setY(aside.y + 0.25 * aside.length()));
    }
    camera.far = Math.max(camera.far, 20 * from.length());
    camera.updateProjectionMatrix();
    controls.update();
  }

  clear() {
    this.content.traverse((object) => {
      object.geometry?.dispose();
      object.material?.dispose();
    });
    this.content.clear();
  }
}

function matrix4(rows) {
  return new Matrix4().set(...rows, 0, 0, 0, 1);
}

function placed(object, matrix) {
  object.matrixAutoUpdate = false;
  object.matrix.copy(matrix);
  object.frustumCulled = false;
  return object;
}

function surface(color, kind) {
  const translucent = { transparent: true, opacity: 0.45, depthWrite: false };
  return new MeshLambertMaterial({
    // Paler than the lines, for contrast.
    color: new Color(color).lerp(new Color("white"), 0.3),
    side: DoubleSide,
    flatShading: true,
    polygonOffset: true,
    polygonOffsetFactor: kind === "gt" ? -1 : 1,
    polygonOffsetUnits: 1,
    ...(kind === "gt" ? translucent : {}),
  });
}

function geometryOf(points, faces) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(Float32Array.from(points.flat()), 3));
  geometry.setIndex(new BufferAttribute(faces, 1));
  return geometry;
}

function segments(points, edges, color, width) {
  const geometry = new LineSegmentsGeometry();
  geometry.setPositions(edges.flatMap(([i, j]) => [...points[i], ...points[j]]));
  return new LineSegments2(geometry, new LineMaterial({ color, linewidth: width }));
}
