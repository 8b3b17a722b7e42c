// The result in three dimensions: the stretched model before its photo, and the camera.
import {
  BufferGeometry,
  Float32BufferAttribute,
  Group,
  LineBasicMaterial,
  LineSegments,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  SRGBColorSpace,
  Texture,
  Vector3,
} from "three";

const BEHIND = 1.25; // of the photo, over the distance of the farthest corner of the model
const CAMERA = "#1f5fbf";
export const ASIDE = new Vector3(1.1, 0.55, 0.75); // from where it is looked at

/**
 * The group, in the axes of a camera that looks along -z with y up.
 *
 * @param {Group} model - in the page's coordinates
 * @param {object} alignment - of the state: camera_from_page, intrinsics
 * @param {object} size - width and height of the photo [px]
 * @param {HTMLImageElement|null} picture - the photo
 */
export function makeResult(model, alignment, { width, height }, picture) {
  const { fx, fy, cx, cy } = alignment.intrinsics;
  const placed = model.clone();
  placed.matrixAutoUpdate = false;
  placed.matrix.makeScale(1, -1, -1).multiply(new Matrix4().set(...alignment.camera_from_page));
  const rows = alignment.camera_from_page;
  const reach = Math.hypot(rows[8], rows[9], rows[10]);
  const depth = BEHIND * (rows[11] + reach / 2);
  const corner = (u, v) => [((u - cx) * depth) / fx, (-(v - cy) * depth) / fy, -depth];
  const corners = [corner(-0.5, -0.5), corner(width - 0.5, -0.5), corner(width - 0.5, height - 0.5), corner(-0.5, height - 0.5)];
  const group = new Group();
  group.add(placed, frustum(corners));
  if (picture) group.add(photoPlane(corners, picture));
  return group;
}

/** Give back what the group holds beside the model's own geometry. */
export function disposeResult(group) {
  for (const { geometry, material } of group.children.slice(1)) {
    geometry.dispose();
    material.map?.dispose();
    material.dispose();
  }
}

function frustum(corners) {
  const places = corners.flatMap((each, at) => [[0, 0, 0], each, each, corners[(at + 1) % 4]]);
  const lines = new BufferGeometry();
  lines.setAttribute("position", new Float32BufferAttribute(places.flat(), 3));
  return new LineSegments(lines, new LineBasicMaterial({ color: CAMERA }));
}

function photoPlane(corners, picture) {
  const plane = new BufferGeometry();
  plane.setAttribute("position", new Float32BufferAttribute(corners.flat(), 3));
  plane.setAttribute("uv", new Float32BufferAttribute([0, 1, 1, 1, 1, 0, 0, 0], 2));
  plane.setIndex([0, 3, 2, 0, 2, 1]);
  const map = new Texture(picture);
  map.colorSpace = SRGBColorSpace;
  map.needsUpdate = true;
  return new Mesh(plane, new MeshBasicMaterial({ map, side: 2 }));
}
