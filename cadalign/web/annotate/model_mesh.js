// The model as three.js objects: shaded triangles, creases, and named axes.
import {
  BufferAttribute,
  BufferGeometry,
  CanvasTexture,
  Color,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  Sprite,
  SpriteMaterial,
  SRGBColorSpace,
  Vector3,
} from "three";
import { studioMaterial } from "./studio.js";

const AXES = [["x", "#c62828"], ["y", "#1b7f3b"], ["z", "#1f5fbf"]];
const DARK = 60; // mean level of models whose creases are drawn light
const DARK_CREASE = { color: 0x10151c, opacity: 0.35 };
const LIGHT_CREASE = { color: 0xc4ccd6, opacity: 0.4 };
const BEYOND = 0.12; // how far the axes stick out of the model [diagonals]

async function fetched(address) {
  const response = await fetch(address);
  if (!response.ok) throw new Error(await response.text());
  return response.arrayBuffer();
}

/** Fetch the model; resolves to its numbers of faces, all triangles (for picking), and the group. */
export async function fetchModel() {
  const [buffer, details] = await Promise.all(["model", "details"].map(fetched));
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const { shown } = header;
  const start = 4 + length;
  const position = new Float32Array(buffer, start, 9 * shown);
  const normal = new Float32Array(buffer, start + 36 * shown, 9 * shown);
  const bytes = new Uint8Array(buffer, start + 72 * shown, 3 * shown);
  const lines = new DataView(details).getUint32(0, true);
  const creases = new Float32Array(details, 4, 6 * lines);
  const opacity = new Uint8Array(details, 4 + 24 * lines, shown);
  const doubled = new Uint8Array(details, 4 + 24 * lines + shown, shown);

  const all = new BufferGeometry();
  all.setAttribute("position", new BufferAttribute(position, 3));
  all.setAttribute("normal", new BufferAttribute(normal, 3));
  all.setAttribute("tint", new BufferAttribute(tints(bytes, opacity), 4));
  all.setAttribute("doubled", new BufferAttribute(Float32Array.from({ length: 3 * shown }, (_, k) => doubled[Math.floor(k / 3)]), 1));
  const group = new Group();
  const [solid, glass] = split(opacity);
  for (const [faces, transparent] of [[solid, false], [glass, true]]) {
    if (!faces.length) continue;
    const geometry = all.clone();
    geometry.setIndex(faces.flatMap((face) => [3 * face, 3 * face + 1, 3 * face + 2]));
    group.add(new Mesh(geometry, studioMaterial({ transparent })));
  }
  const edges = new BufferGeometry();
  edges.setAttribute("position", new BufferAttribute(creases, 3));
  const level = bytes.reduce((sum, each) => sum + each, 0) / Math.max(bytes.length, 1);
  const line = level < DARK ? LIGHT_CREASE : DARK_CREASE;
  group.add(new LineSegments(edges, new LineBasicMaterial({ ...line, transparent: true })));
  const mesh = new Mesh(all, studioMaterial({ transparent: false }));
  return { header, mesh, group };
}

/** Axes through the middle of the model, in both directions named by sign. */
export function makeAxes(box) {
  const group = new Group();
  const middle = box.getCenter(new Vector3());
  const half = box.getSize(new Vector3()).multiplyScalar(0.5);
  AXES.forEach(([name, color], axis) => {
    const end = middle.clone().setComponent(axis, middle.getComponent(axis) + half.getComponent(axis) + BEYOND);
    const line = new BufferGeometry().setFromPoints([middle, end]);
    const material = new LineBasicMaterial({ color, transparent: true, opacity: 0.8, depthTest: false });
    const drawn = new LineSegments(line, material);
    drawn.renderOrder = 1;
    group.add(drawn, label(name, color, end));
  });
  return group;
}

function label(name, color, place) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const context = canvas.getContext("2d");
  context.font = "700 46px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 10;
  context.strokeStyle = "#ffffff";
  context.strokeText(name, 32, 32);
  context.fillStyle = color;
  context.fillText(name, 32, 32);
  const map = new CanvasTexture(canvas);
  map.colorSpace = SRGBColorSpace;
  const sprite = new Sprite(new SpriteMaterial({ map, sizeAttenuation: false, depthTest: false, transparent: true }));
  sprite.position.copy(place);
  sprite.scale.setScalar(0.045);
  sprite.renderOrder = 3;
  return sprite;
}

function split(opacity) {
  const groups = [[], []];
  opacity.forEach((value, face) => groups[value < 255 ? 1 : 0].push(face));
  return groups;
}

/** Linear colours and opacities of all corners, from the triangles' sRGB bytes. */
function tints(bytes, opacity) {
  const linear = Float32Array.from({ length: 256 }, (_, level) =>
    new Color().setRGB(level / 255, 0, 0, SRGBColorSpace).r,
  );
  const tint = new Float32Array(12 * opacity.length);
  for (let corner = 0; corner < 3 * opacity.length; corner += 1) {
    const face = Math.floor(corner / 3);
    for (let k = 0; k < 3; k += 1) tint[4 * corner + k] = linear[bytes[3 * face + k]];
    tint[4 * corner + 3] = opacity[face] / 255;
  }
  return tint;
}
