// Marking a mask or vertical edges in the photo, in place of points.
import { strokeTwice } from "./marker.js";

const MASK = "#b04dff";
const VERTICAL = "#4be38a";

/** Tools by name: label, key, and what to do with it. */
export const TOOLS = {
  points: { label: "Points", key: "p", how: "" },
  box: { label: "Mask: box", key: "x", how: "Draw a box around the object: it is cut out by its colours." },
  vertical: { label: "Vertical edge", key: "u", how: "Draw along two or more vertical edges, far apart." },
};

export class Marking {
  /**
   * @param {object} view - the photo's view
   * @param {(action: object) => void} act
   */
  constructor(view, act) {
    this.view = view;
    this.act = act;
    this.tool = "points";
    this.path = []; // [px of the photo]
  }

  get active() {
    return this.tool !== "points";
  }

  choose(tool) {
    this.tool = tool;
    this.cancel();
  }

  /** Forget what is begun; says whether there was something. */
  cancel() {
    const begun = this.path.length > 0;
    this.path = [];
    this.hover = null;
    this.view.invalidate();
    return begun;
  }

  press(uv) {
    if (this.path.length > 0) this.path[1] = uv;
    else this.path = [uv];
    this.view.invalidate();
  }

  drag(uv) {
    this.path[1] = uv;
    this.view.invalidate();
  }

  /** A box or an edge is drawn by dragging, or by two clicks. */
  release(uv, moved) {
    if (!moved && this.path.length < 2) return;
    const ends = [this.path[0], uv];
    this.cancel();
    this.act(this.tool === "box" ? { do: "mask_cut", corners: ends } : { do: "vertical", ends });
  }

  /** The same by the keyboard, at the middle of the view. */
  confirm(uv) {
    this.press(uv);
    this.release(uv, false);
  }

  follow(uv) {
    if (!this.path.length) return;
    this.hover = uv;
    this.view.invalidate();
  }

  /** Draw the mask, the vertical edges and what is begun. */
  draw(context, evidence) {
    this.drawMask(context, evidence);
    for (const ends of evidence?.verticals ?? []) this.stroke(context, ends, VERTICAL, 3);
    const path = this.hover ? [this.path[0], this.hover] : this.path;
    if (!path.length) return;
    if (this.tool === "box" && path.length > 1) {
      const [[x1, y1], [x2, y2]] = path;
      this.stroke(context, [[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]], MASK, 2);
    } else {
      this.stroke(context, path, this.tool === "vertical" ? VERTICAL : MASK, 2);
    }
  }

  drawMask(context, evidence) {
    const key = evidence?.mask ?? null;
    const of = `mask/${this.view.state.image.number}`;
    if (key !== this.key || of !== this.of) {
      this.key = key;
      this.of = of;
      this.tinted = null;
      if (key !== null) this.load(key, of);
    }
    if (!this.tinted) return;
    const corner = this.view.toView([-0.5, -0.5]);
    const { width, height } = this.view.size;
    const { scale } = this.view;
    context.save();
    context.globalAlpha = 0.4;
    context.drawImage(this.tinted, corner.x, corner.y, width * scale, height * scale);
    context.restore();
  }

  async load(key, of) {
    const image = new Image();
    image.src = `${of}?${key}`;
    try {
      await image.decode();
    } catch {
      return; // the next state reports what is wrong
    }
    if (key !== this.key || of !== this.of) return;
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const context = canvas.getContext("2d");
    context.fillStyle = MASK;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.globalCompositeOperation = "destination-in";
    context.drawImage(image, 0, 0);
    this.tinted = canvas;
    this.view.invalidate();
  }

  stroke(context, path, color, width) {
    context.save();
    context.lineCap = context.lineJoin = "round";
    context.beginPath();
    for (const uv of path) {
      const { x, y } = this.view.toView(uv);
      context.lineTo(x, y);
      if (path.length === 1) context.lineTo(x + 0.1, y);
    }
    strokeTwice(context, color, width, 2.5);
    context.restore();
  }
}

/** The runs of a mask's pixels outside and inside in turn, row by row, from a file of that size. */
export async function readMask(file, { width, height }) {
  const picture = await createImageBitmap(file);
  if (picture.width !== width || picture.height !== height) {
    throw new Error(`${file.name} has ${picture.width} x ${picture.height} pixels, the photo ${width} x ${height}.`);
  }
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  context.drawImage(picture, 0, 0);
  const { data } = context.getImageData(0, 0, width, height);
  const runs = [0];
  let inside = false;
  for (let k = 0; k < data.length; k += 4) {
    const now = data[k + 3] > 0 && data[k] + data[k + 1] + data[k + 2] > 0;
    if (now !== inside) runs.push(0);
    inside = now;
    runs[runs.length - 1] += 1;
  }
  return runs;
}
