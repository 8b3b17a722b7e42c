// Poses of estimates: depth * (u, v, 1) = K (R diag(scale) x + t).

import { warpOf } from "./warp.js";

const ONES = [1, 1, 1];
const NEAR = 1e-6;

/** x -> R diag(scale) x + t as 12 numbers, row by row. */
export function matrixOf({ rotation, translation, scale }) {
  const rows = [];
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) rows.push(rotation[3 * i + j] * scale[j]);
    rows.push(translation[i]);
  }
  return rows;
}

/** Stretch the data set's points to the given model, and warp them if the pose has a warp. */
export function shapeOf(exhibit, pose, points) {
  const { stretch = ONES } = exhibit;
  return warped(exhibit, pose, points.map((point) => point.map((value, k) => value * stretch[k])));
}

/** Points of the given model, warped if the pose has a warp. */
export function warped({ bounds }, { warp }, points) {
  return warp && bounds ? warpOf(warp, bounds)(points) : points;
}

/** Points in the camera's axes. */
export function transform(matrix, points) {
  return points.map(([x, y, z]) =>
    [0, 4, 8].map(
      (row) => matrix[row] * x + matrix[row + 1] * y + matrix[row + 2] * z + matrix[row + 3],
    ),
  );
}

/** The pixel of a point in the camera's axes; null behind the camera. */
export function pixel(camera, [x, y, z]) {
  return z > NEAR ? [(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy] : null;
}

/** End pixels of the part of a segment in front of the camera, or null. */
export function segment(camera, a, b) {
  const near = Math.max(NEAR, 1e-3 * Math.max(Math.abs(a[2]), Math.abs(b[2])));
  if (a[2] < near && b[2] < near) return null;
  if (a[2] < near) return segment(camera, b, a)?.reverse() ?? null;
  if (b[2] < near) {
    const share = (a[2] - near) / (a[2] - b[2]);
    b = [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), near];
  }
  return [pixel(camera, a), pixel(camera, b)];
}

/** Segments as the data of one SVG path. */
export function pathOf(camera, points, edges) {
  const parts = [];
  for (const [i, j] of edges) {
    const ends = segment(camera, points[i], points[j]);
    if (!ends) continue;
    const [[x0, y0], [x1, y1]] = ends;
    parts.push(`M${x0.toFixed(1)} ${y0.toFixed(1)}L${x1.toFixed(1)} ${y1.toFixed(1)}`);
  }
  return parts.join("");
}

/** The eight corners of a box [[low], [high]], and its twelve edges. */
export function cornersOf([low, high]) {
  return Array.from({ length: 8 }, (_, k) =>
    [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high : low)[axis]),
  );
}

export const BOX_EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((k) =>
  [1, 2, 4].filter((bit) => !(k & bit)).map((bit) => [k, k | bit]),
);

/** Transform from the camera's axes to the upright axes of the posed object, row by row. */
export function anchorOf({ rotation: r, translation: t }) {
  return [0, 1, 2].flatMap((j) => [
    r[j],
    r[3 + j],
    r[6 + j],
    -(r[j] * t[0] + r[3 + j] * t[1] + r[6 + j] * t[2]),
  ]);
}
