// The photo: zoomed, panned, and drawn over with points and the alignment.
import { failureOf } from "./api.js";
import { drawBadge, kindOf, strokeTwice } from "./marker.js";
import { drawPhotoLoupe, Loupe } from "./loupe.js";
import { Marking } from "./marking.js";
import { PhotoGestures } from "./photo_gestures.js";

const MARGIN = 12;
const MOST_ZOOM = 64;
const REACH = 16;
const PIXELS_FROM = 4; // from this zoom on, pixels are shown as squares
const BADGE_OFFSET = 17;
const FAINT = "rgb(255 150 225 / 30%)";
const UNCERTAIN = "#ff96e1"; // estimated keypoints that are not marked, and their regions

export class PhotoView {
  /**
   * @param {HTMLElement} host - the element to fill
   * @param {object} handlers - onPlace(uv), onSelect(pair), onMove(pair, uv, done)
   */
  constructor(host, handlers) {
    this.host = host;
    this.handlers = handlers;
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "application");
    this.canvas.setAttribute(
      "aria-label",
      "Photo. Enter places a point at the middle of the view; arrow keys nudge the selected point; plus and minus zoom.",
    );
    host.append(this.canvas);
    this.loupe = new Loupe(host);
    this.context = this.canvas.getContext("2d");
    this.picture = null;
    this.size = { width: 1, height: 1 };
    this.scale = 1;
    this.offset = { x: 0, y: 0 };
    this.state = null;
    this.selected = null;
    this.dragged = null;
    this.onDrawn = null;
    this.overlay = { mode: "edges", opacity: 1, hidden: false };
    this.shaded = null;
    this.marking = new Marking(this, (action) => this.handlers.onMark(action));
    this.gestures = new PhotoGestures(this);
    new ResizeObserver(() => this.resize()).observe(host);
    this.resize();
  }

  /** Choose how the alignment is drawn: mode off, box, edges or shaded; opacity; hidden. */
  setOverlay(changed) {
    Object.assign(this.overlay, changed);
    this.invalidate();
  }

  /** Show another photo. */
  async open(number, { width, height }) {
    this.number = number;
    this.size = { width, height };
    this.marking.cancel();
    this.picture = null;
    this.state = null;
    this.fit();
    const picture = new Image();
    picture.src = `photo/${number}`;
    this.wanted = picture;
    try {
      await picture.decode();
    } catch {
      const { wanted } = this;
      const reason = await failureOf(picture.src);
      if (this.wanted === wanted) this.handlers.onTrouble(reason ?? "The browser cannot show this photo.");
      return;
    }
    if (this.wanted !== picture) return;
    this.picture = picture;
    this.invalidate();
  }

  show(state, selected) {
    this.state = state;
    this.selected = selected;
    this.invalidate();
  }

  /** Zoom and pan so that the whole photo is seen. */
  fit() {
    const { width, height } = this.size;
    const { clientWidth, clientHeight } = this.canvas;
    this.scale = Math.min((clientWidth - 2 * MARGIN) / width, (clientHeight - 2 * MARGIN) / height);
    this.scale = Math.max(this.scale, 1e-3);
    this.least = this.scale / 2;
    this.offset = {
      x: (clientWidth - (width - 1) * this.scale) / 2,
      y: (clientHeight - (height - 1) * this.scale) / 2,
    };
    this.fitted = true;
    this.invalidate();
  }

  /** Zoom by a factor about a place of the view, by default its middle. */
  zoom(factor, center = this.middle) {
    const scale = Math.min(Math.max(this.scale * factor, this.least ?? 0), MOST_ZOOM);
    const ratio = scale / this.scale;
    this.offset = {
      x: center.x + (this.offset.x - center.x) * ratio,
      y: center.y + (this.offset.y - center.y) * ratio,
    };
    this.scale = scale;
    this.fitted = false;
    this.invalidate();
  }

  pan(x, y) {
    this.offset = { x: this.offset.x + x, y: this.offset.y + y };
    this.fitted = false;
    this.invalidate();
  }

  get middle() {
    return { x: this.canvas.clientWidth / 2, y: this.canvas.clientHeight / 2 };
  }

  /** Place in the view of a pixel; integers are pixel centres. */
  toView([u, v]) {
    return { x: u * this.scale + this.offset.x, y: v * this.scale + this.offset.y };
  }

  /** Pixel at a place of the view. */
  toPixel({ x, y }) {
    return [(x - this.offset.x) / this.scale, (y - this.offset.y) / this.scale];
  }

  /** Whether a pixel lies in the photo. */
  contains([u, v]) {
    const { width, height } = this.size;
    return u >= -0.5 && v >= -0.5 && u <= width - 0.5 && v <= height - 0.5;
  }

  /** The nearest pixel that lies in the photo. */
  clamp([u, v]) {
    const { width, height } = this.size;
    return [
      Math.min(Math.max(u, -0.5), width - 0.5),
      Math.min(Math.max(v, -0.5), height - 0.5),
    ];
  }

  /** The pair whose point is at a place of the view, if any. */
  pairAt(place) {
    const gap = ({ uv }) => {
      const own = this.toView(uv);
      return Math.hypot(own.x - place.x, own.y - place.y);
    };
    const points = this.state?.pairs.filter((pair) => pair.uv && gap(pair) < REACH) ?? [];
    return points.sort((a, b) => gap(a) - gap(b))[0] ?? null;
  }

  resize() {
    const { clientWidth, clientHeight } = this.host;
    if (!clientWidth || !clientHeight) return;
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(clientWidth * ratio);
    this.canvas.height = Math.round(clientHeight * ratio);
    if (this.fitted !== false) this.fit();
    this.invalidate();
  }

  invalidate() {
    this.pending ??= requestAnimationFrame(() => {
      this.pending = null;
      this.draw();
    });
  }

  draw() {
    const { context, canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (this.picture) {
      const corner = this.toView([-0.5, -0.5]);
      context.imageSmoothingEnabled = this.scale < PIXELS_FROM;
      context.imageSmoothingQuality = "high";
      const { width, height } = this.size;
      context.drawImage(this.picture, corner.x, corner.y, width * this.scale, height * this.scale);
    }
    if (this.state) {
      const { mode, opacity, hidden } = this.overlay;
      if (!hidden) this.marking.draw(this.context, this.state.evidence);
      if (mode !== "off" && !hidden) {
        this.context.globalAlpha = opacity;
        this.drawAlignment(this.state.alignment, mode);
        this.context.globalAlpha = 1;
      }
      const { suggestion } = this.state;
      if (suggestion) this.drawDashed("suggested", "", suggestion.uv);
      this.drawPairs(this.state.pairs);
    }
    const loupe = this.loupe.place();
    if (loupe && this.picture) drawPhotoLoupe(this, loupe);
    this.onDrawn?.();
  }

  drawAlignment(alignment, mode) {
    if (alignment.status !== "done") return;
    const isShaded = mode === "shaded" && alignment.camera_from_page !== null && this.shaded;
    if (isShaded) {
      const { clientWidth: width, clientHeight: height } = this.canvas;
      const seen = this.shaded.draw(alignment, { scale: this.scale, offset: this.offset, width, height });
      this.context.drawImage(seen, 0, 0, width, height);
    }
    this.context.strokeStyle = FAINT;
    this.context.lineWidth = 0.8;
    for (const region of alignment.faint_regions) {
      this.outline(region);
      this.context.stroke();
    }
    if (mode === "edges" || (mode === "shaded" && !isShaded)) this.strokeLines(alignment.lines, "#35d0ff", 1.2);
    this.strokeLines(alignment.box, "#ff5a63", 2);
    for (const region of alignment.regions) {
      this.outline(region);
      strokeTwice(this.context, UNCERTAIN, 1.2, 1.4, 35);
    }
    for (const { uv, state } of alignment.keypoints) {
      if (state === "unmarked") this.drawRing(this.toView(uv));
    }
  }

  /** Outline a closed curve given as x1, y1, x2, y2, ... in pixels. */
  outline(values) {
    const { context } = this;
    context.beginPath();
    for (let k = 0; k < values.length; k += 2) {
      const { x, y } = this.toView([values[k], values[k + 1]]);
      context.lineTo(x, y);
    }
    context.closePath();
  }

  /** Where an estimated keypoint is that is not marked. */
  drawRing({ x, y }) {
    const { context } = this;
    context.beginPath();
    context.arc(x, y, 3.5, 0, 2 * Math.PI);
    strokeTwice(context, UNCERTAIN, 1.8, 1.8);
  }

  /** Stroke lines given as x1, y1, x2, y2, ... in pixels. */
  strokeLines(values, style, width) {
    const { context } = this;
    context.beginPath();
    for (let k = 0; k < values.length; k += 4) {
      const from = this.toView([values[k], values[k + 1]]);
      const to = this.toView([values[k + 2], values[k + 3]]);
      context.moveTo(from.x, from.y);
      context.lineTo(to.x, to.y);
    }
    context.lineCap = "round";
    strokeTwice(context, style, width, 1.6, 45);
  }

  /** A dashed badge at a pixel where a point is expected. */
  drawDashed(kind, label, uv) {
    const { x, y } = this.toView(uv);
    this.context.setLineDash([4, 3]);
    drawBadge(this.context, kind, label, x, y);
    this.context.setLineDash([]);
  }

  drawPairs(pairs) {
    for (const pair of pairs) {
      if (pair.expected) this.drawDashed("suggested", String(pair.pair), pair.expected);
      if (!pair.uv) continue;
      const uv = this.dragged?.pair === pair.pair ? this.dragged.uv : pair.uv;
      const place = this.toView(uv);
      if (pair.residual && !this.dragged) {
        this.drawArrow(place, this.toView([uv[0] + pair.residual[0], uv[1] + pair.residual[1]]));
      }
      const kind = kindOf(pair, this.selected);
      this.drawCross(place, kind);
      drawBadge(this.context, kind, String(pair.pair), place.x + BADGE_OFFSET, place.y - BADGE_OFFSET);
    }
  }

  /** A cross that leaves the pixel itself free. */
  drawCross({ x, y }, kind) {
    const { context } = this;
    const [inner, outer] = [3, 9];
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + inner * dx, y + inner * dy);
      context.lineTo(x + outer * dx, y + outer * dy);
    }
    const color = { selected: "#ffd23f", wrong: "#ff8a80" }[kind] ?? "#ffffff";
    strokeTwice(context, color, 1.8, 2.2, 75);
  }

  /** From where a point was placed to where the alignment puts it. */
  drawArrow(from, to) {
    const length = Math.hypot(to.x - from.x, to.y - from.y);
    if (length < 2) return;
    const { context } = this;
    const angle = Math.atan2(to.y - from.y, to.x - from.x);
    const head = Math.min(9, length / 2);
    context.beginPath();
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
    for (const turn of [-0.45, 0.45]) {
      context.moveTo(to.x, to.y);
      context.lineTo(to.x - head * Math.cos(angle + turn), to.y - head * Math.sin(angle + turn));
    }
    strokeTwice(context, "#ffb02e", 2.2, 2.3, 70);
  }
}
