// Marking a mask in the photo by a box, in place of points.
import { strokeTwice } from "./marker.js";

const MASK = "#b04dff";

/** Tools by name: label, key, and what to do with it. */
export const TOOLS = {
  points: { label: "Points", key: "p", how: "" },
  box: { label: "Mask: box", key: "x", how: "Draw a box around the object: it is cut out by its colours." },
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

  /** A box is drawn by dragging, or by two clicks. */
  release(uv, moved) {
    if (!moved && this.path.length < 2) return;
    const ends = [this.path[0], uv];
    this.cancel();
    this.act({ do: "mask_cut", corners: ends });
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

  /** Draw the mask and the box that is begun. */
  draw(context, evidence) {
    this.drawMask(context, evidence);
    const path = this.hover ? [this.path[0], this.hover] : this.path;
    if (!path.length) return;
    const [[x1, y1], [x2, y2] = path[0]] = path;
    this.stroke(context, [[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]]);
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

  stroke(context, path) {
    context.save();
    context.lineCap = context.lineJoin = "round";
    context.beginPath();
    for (const uv of path) {
      const { x, y } = this.view.toView(uv);
      context.lineTo(x, y);
    }
    strokeTwice(context, MASK, 2, 2.5);
    context.restore();
  }
}
