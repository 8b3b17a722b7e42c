// Boxes, keypoints and wireframes drawn over a picture as SVG, in the picture's own pixels.
import { h, svg } from "../common/dom.js";
import {
  BOX_EDGES,
  cornersOf,
  matrixOf,
  pathOf,
  pixel,
  shapeOf,
  transform,
  warped,
} from "./pose.js";

export const LAYERS = [
  { key: "g", label: "ground truth", kind: "gt" },
  { key: "p", label: "prediction", kind: "est" },
  { key: "k", label: "keypoints", kind: "point" },
  { key: "w", label: "wireframe", kind: "wire" },
];

/**
 * The overlay of an exhibit.
 *
 * @param {object} exhibit
 * @param {object} options
 * @param {string|null} options.picture - the photo's or rendering's URL
 * @param {object|null} options.estimate - the pose to draw as the prediction
 * @param {object|null} options.wire - points and edges of the model, before its stretch
 * @param {Set<string>} options.layers - keys of `LAYERS`
 * @param {string} options.label - what a screen reader says
 */
export function overlay(exhibit, { picture, estimate, wire = null, layers, label }) {
  const { camera } = exhibit;
  // Pixel centres are integers: a picture extends half a pixel beyond them.
  const drawing = svg("svg", {
    viewBox: `-0.5 -0.5 ${camera.width} ${camera.height}`,
    role: "img",
    "aria-label": label,
    class: picture ? "overlay pictured" : "overlay",
  });
  if (picture) {
    const frame = { x: -0.5, y: -0.5, width: camera.width, height: camera.height };
    drawing.append(svg("image", { href: picture, preserveAspectRatio: "none", ...frame }));
  }
  const poses = [
    ["gt", layers.has("g") ? exhibit.gt : null],
    ["est", layers.has("p") ? estimate : null],
  ];
  for (const [kind, pose] of poses) {
    if (!pose) continue;
    if (wire && layers.has(wire.layer)) {
      const points = transform(matrixOf(pose), shapeOf(exhibit, pose, wire.points));
      drawing.append(svg("path", { class: `wire ${kind}`, d: pathOf(camera, points, wire.edges) }));
    }
    if (exhibit.bounds) drawing.append(...boxPaths(camera, exhibit.bounds, pose, kind));
  }
  if (layers.has("k")) drawing.append(keypoints(exhibit, layers.has("p") ? estimate : null));
  return drawing;
}

/** A box, drawn over a pale halo that separates it from the picture. */
function boxPaths(camera, bounds, pose, kind) {
  const corners = transform(matrixOf(pose), cornersOf(bounds));
  const d = pathOf(camera, corners, BOX_EDGES);
  return [svg("path", { class: "halo", d }), svg("path", { class: `box ${kind}`, d })];
}

/** Observed keypoints as rings, predicted ones as dots, and lines between them. */
function keypoints(exhibit, pose) {
  const { camera, points_2d: seen = [], points_3d: model = [], semantic_ids: ids = [] } = exhibit;
  const group = svg("g", { class: "keypoints" });
  const size = camera.width / 160;
  const predicted = pose
    ? transform(matrixOf(pose), warped(exhibit, pose, model)).map((point) => pixel(camera, point))
    : [];
  seen.forEach(([u, v], i) => {
    const there = predicted[i];
    if (there) {
      group.append(svg("line", { class: "tie", x1: u, y1: v, x2: there[0], y2: there[1] }));
      group.append(
        svg("circle", { class: "predicted", cx: there[0], cy: there[1], r: size * 0.55 }),
      );
    }
    const words = `keypoint ${ids[i] ?? i}`;
    group.append(svg("circle", { class: "seen", cx: u, cy: v, r: size }, svg("title", {}, words)));
  });
  return group;
}

/** The marks of the layers, for their switches. */
export function layerMark(kind) {
  const mark =
    kind === "point"
      ? svg("circle", { class: "seen", cx: 11, cy: 5, r: 3.5 })
      : svg("path", { class: `box ${kind}`, d: "M1 5H21" });
  const drawing = svg("svg", { viewBox: "0 0 22 10" }, mark);
  return h("span", { class: "mark", "aria-hidden": "true" }, drawing);
}
