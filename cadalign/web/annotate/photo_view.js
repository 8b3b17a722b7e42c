// The photo: zoomed, panned, clicked on, and drawn over with points and the alignment.
import { fetched } from "./api.js";
import { drawBadge, kindOf, strokeTwice } from "./drawing.js";

const CLICK_REACH = 4; // a press that moves no farther is a click [px]
const REACH = 16; // of a point to the pointer [px]
const RING_REACH = 8; // of an estimated keypoint to the pointer [px]
const WHEEL = 0.0016;
const MARGIN = 12;
const MOST_ZOOM = 64;
const PIXELS_FROM = 4; // from this zoom on, pixels are shown as squares
const BADGE_OFFSET = 17;
const MASK = "#b04dff";
const PROPOSED = "#ffd23f"; // the keypoint to click on next
const UNCERTAIN = "#ff96e1"; // estimated keypoints that are not marked, and their regions

export class PhotoView {
  /**
   * @param {HTMLElement} host - the element to fill
   * @param {object} handlers - onPlace(uv), onTake(keypoint, uv), onSelect(pair), onMove(pair, uv),
   *   onBox(corners), onTrouble(text)
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
    this.context = this.canvas.getContext("2d");
    this.picture = null;
    this.mask = null; // tinted
    this.size = { width: 1, height: 1 };
    this.scale = 1;
    this.offset = { x: 0, y: 0 };
    this.state = null;
    this.selected = null;
    this.dragged = null; // the pair or the estimated keypoint that is moved, and where to
    this.isBoxing = false; // a drag draws a box, in place of panning
    this.box = null; // two corners
    this.listen();
    new ResizeObserver(() => this.resize()).observe(host);
  }

  /** Show another photo. */
  async open(number, { width, height }) {
    Object.assign(this, { size: { width, height }, picture: null, mask: null, maskKey: null, state: null });
    this.number = number;
    this.fit();
    const picture = await this.load(`photo/${number}`);
    if (this.number !== number) return;
    this.picture = picture;
    this.invalidate();
  }

  async load(address) {
    try {
      return await createImageBitmap(await (await fetched(address)).blob());
    } catch (error) {
      this.handlers.onTrouble(error.message);
      return null;
    }
  }

  show(state, selected) {
    this.state = state;
    this.selected = selected;
    if (!this.press) this.dragged = null;
    this.showMask(state.evidence.mask);
    this.invalidate();
  }

  async showMask(key) {
    if (key === this.maskKey) return;
    this.maskKey = key;
    this.mask = null;
    const image = key && (await this.load(`mask/${this.number}?${key}`));
    if (!image || key !== this.maskKey) return;
    this.mask = new OffscreenCanvas(image.width, image.height);
    const context = this.mask.getContext("2d");
    context.drawImage(image, 0, 0);
    context.globalCompositeOperation = "source-in";
    context.fillStyle = MASK;
    context.fillRect(0, 0, image.width, image.height);
    this.invalidate();
  }

  /** Zoom and pan so that the whole photo is seen. */
  fit() {
    const { width, height } = this.size;
    const { clientWidth, clientHeight } = this.host;
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
    this.scale = scale;
    this.offset = {
      x: center.x + (this.offset.x - center.x) * ratio,
      y: center.y + (this.offset.y - center.y) * ratio,
    };
    this.fitted = false;
    this.invalidate();
  }

  pan(x, y) {
    this.offset = { x: this.offset.x + x, y: this.offset.y + y };
    this.fitted = false;
    this.invalidate();
  }

  get middle() {
    return { x: this.host.clientWidth / 2, y: this.host.clientHeight / 2 };
  }

  /** Place in the view of a pixel; integers are pixel centres. */
  toView([u, v]) {
    return { x: u * this.scale + this.offset.x, y: v * this.scale + this.offset.y };
  }

  /** Pixel at a place of the view. */
  toPixel({ x, y }) {
    return [(x - this.offset.x) / this.scale, (y - this.offset.y) / this.scale];
  }

  /** The nearest pixel that lies in the photo. */
  clamp([u, v]) {
    const { width, height } = this.size;
    return [Math.min(Math.max(u, -0.5), width - 0.5), Math.min(Math.max(v, -0.5), height - 0.5)];
  }

  /** Place a point at a place of the view, if that is in the photo. */
  place(at = this.middle) {
    const uv = this.toPixel(at);
    const [u, v] = this.clamp(uv);
    if (u === uv[0] && v === uv[1]) this.handlers.onPlace(uv);
  }

  /** Move a pair's point on the screen; the next state shows it where it is then. */
  drag(pair, uv) {
    this.dragged = { pair, uv: this.clamp(uv) };
    this.invalidate();
  }

  /** Let the next drag draw a box, or no more. */
  boxing(on) {
    this.isBoxing = on;
    this.box = null;
    this.invalidate();
  }

  /** The pair whose point is at a place of the view, if any. */
  pairAt(place) {
    return this.nearest(this.state?.pairs.filter(({ uv }) => uv) ?? [], place, REACH);
  }

  /** The estimated keypoint that is at a place of the view, if any; only without a CAD model. */
  ringAt(place) {
    const { model, alignment } = this.state ?? {};
    return model?.is_skeleton && !this.hidden ? this.nearest(alignment.unmarked ?? [], place, RING_REACH) : null;
  }

  nearest(points, place, reach) {
    const gap = ({ uv }) => {
      const own = this.toView(uv);
      return Math.hypot(own.x - place.x, own.y - place.y);
    };
    return points.filter((point) => gap(point) < reach).sort((a, b) => gap(a) - gap(b))[0] ?? null;
  }

  listen() {
    const { canvas } = this;
    const placed = (act) => (event) => {
      const { left, top } = canvas.getBoundingClientRect();
      act.call(this, event, { x: event.clientX - left, y: event.clientY - top });
    };
    canvas.addEventListener("pointerdown", placed(this.down));
    canvas.addEventListener("pointermove", placed(this.move));
    canvas.addEventListener("pointerup", placed(this.up));
    canvas.addEventListener("pointercancel", () => this.cancel());
    canvas.addEventListener("wheel", placed(this.wheel), { passive: false });
  }

  down(event, place) {
    if (event.button !== 0 || !event.isPrimary) return;
    this.canvas.setPointerCapture(event.pointerId);
    const pair = this.isBoxing ? null : this.pairAt(place);
    const ring = this.isBoxing || pair ? null : this.ringAt(place);
    // The point does not jump to the pointer: it keeps its distance.
    const own = (pair ?? ring) && this.toView((pair ?? ring).uv);
    const grip = own && { x: own.x - place.x, y: own.y - place.y };
    this.press = { start: place, last: place, pair, ring, grip, moved: false };
  }

  move(event, place) {
    const { press } = this;
    if (!press) {
      const ring = this.ringAt(place);
      const keypoint = ring && this.state.keypoints.find((each) => each.keypoint === ring.keypoint);
      this.canvas.title = keypoint?.name ?? "";
      this.canvas.style.cursor = !this.isBoxing && (ring || this.pairAt(place)) ? "grab" : "crosshair";
      return;
    }
    const { start, last, pair, ring, grip } = press;
    press.moved ||= Math.hypot(place.x - start.x, place.y - start.y) > CLICK_REACH;
    if (!press.moved) return;
    if (this.isBoxing) this.box = [start, place].map((corner) => this.clamp(this.toPixel(corner)));
    else if (pair || ring) {
      const uv = this.clamp(this.toPixel({ x: place.x + grip.x, y: place.y + grip.y }));
      this.dragged = { ...(pair ?? ring), uv };
    }
    else this.pan(place.x - last.x, place.y - last.y);
    press.last = place;
    this.invalidate();
  }

  up() {
    const { press, box } = this;
    this.press = null;
    if (!press) return;
    const { start, pair, ring, moved } = press;
    if (moved && this.isBoxing) this.handlers.onBox(box);
    else if (moved && pair) this.handlers.onMove(pair.pair, this.dragged.uv);
    else if (!moved && pair) this.handlers.onSelect(pair.pair);
    else if (moved && ring) this.handlers.onTake(ring.keypoint, this.dragged.uv);
    // The proposed keypoint is placed where the click is, which may be beside its estimate.
    else if (ring && ring.keypoint !== this.state.model.proposed) this.handlers.onTake(ring.keypoint, ring.uv);
    else if (!moved && !this.isBoxing) this.place(start);
  }

  cancel() {
    this.press = this.dragged = this.box = null;
    this.invalidate();
  }

  wheel(event, place) {
    event.preventDefault();
    // Lines or pages instead of pixels; a pinch on a touchpad comes as a wheel with the control key.
    const unit = [1, 16, 400][event.deltaMode];
    const speed = event.ctrlKey ? 5 * WHEEL : WHEEL;
    this.zoom(Math.exp(-event.deltaY * unit * speed), place);
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
    const { context, canvas, state } = this;
    const ratio = window.devicePixelRatio || 1;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.lineCap = context.lineJoin = "round";
    context.imageSmoothingEnabled = this.scale < PIXELS_FROM;
    context.imageSmoothingQuality = "high";
    this.drawPicture(this.picture, 1);
    if (!state) return;
    if (!this.hidden) {
      this.drawPicture(this.mask, 0.4);
      this.drawAlignment(state.alignment);
    }
    if (this.box) {
      const [[u1, v1], [u2, v2]] = this.box;
      this.stroke([[u1, v1, u2, v1, u2, v2, u1, v2, u1, v1]], MASK, 2);
    }
    for (const pair of state.pairs) if (pair.uv) this.drawPair(pair);
  }

  drawPicture(picture, opacity) {
    if (!picture) return;
    const { x, y } = this.toView([-0.5, -0.5]);
    const { width, height } = this.size;
    this.context.globalAlpha = opacity;
    this.context.drawImage(picture, x, y, width * this.scale, height * this.scale);
    this.context.globalAlpha = 1;
  }

  drawAlignment({ status, lines, box, regions, unmarked }) {
    if (status !== "done") return;
    this.stroke(lines, "#35d0ff", 1.2);
    this.stroke(box, "#ff5a63", 2);
    this.drawRegions(regions, unmarked);
    for (const each of unmarked) {
      const { keypoint, uv } = this.dragged?.keypoint === each.keypoint ? this.dragged : each;
      const { x, y } = this.toView(uv);
      this.context.beginPath();
      this.context.arc(x, y, 3.5, 0, 2 * Math.PI);
      strokeTwice(this.context, keypoint === this.state.model.proposed ? PROPOSED : UNCERTAIN, 1.8);
    }
  }

  /** Without a CAD model there are many regions: all but the proposed keypoint's are faint. */
  drawRegions(regions, unmarked) {
    const { is_skeleton: isSkeleton, proposed } = this.state.model;
    const isClear = (_, row) => !isSkeleton || unmarked[row].keypoint === proposed;
    this.context.globalAlpha = 0.3;
    this.stroke(regions.filter((...each) => !isClear(...each)), UNCERTAIN, 0.8);
    this.context.globalAlpha = 1;
    this.stroke(regions.filter(isClear), isSkeleton ? PROPOSED : UNCERTAIN, 1.2);
  }

  /** Stroke paths, each given as u1, v1, u2, v2, ... in pixels. */
  stroke(paths, style, width) {
    const { context } = this;
    context.beginPath();
    for (const path of paths) {
      for (let k = 0; k < path.length; k += 2) {
        const { x, y } = this.toView([path[k], path[k + 1]]);
        if (k) context.lineTo(x, y);
        else context.moveTo(x, y);
      }
    }
    strokeTwice(context, style, width);
  }

  drawPair(pair) {
    const { context } = this;
    const isMoved = this.dragged?.pair === pair.pair;
    const uv = isMoved ? this.dragged.uv : pair.uv;
    const place = this.toView(uv);
    if (pair.residual && !isMoved) {
      this.drawArrow(place, this.toView([uv[0] + pair.residual[0], uv[1] + pair.residual[1]]));
    }
    const kind = kindOf(pair, this.selected);
    // A cross that leaves the pixel itself free.
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(place.x + 3 * dx, place.y + 3 * dy);
      context.lineTo(place.x + 9 * dx, place.y + 9 * dy);
    }
    strokeTwice(context, { selected: "#ffd23f", wrong: "#ff8a80" }[kind] ?? "#ffffff", 1.8);
    drawBadge(context, kind, String(pair.pair), place.x + BADGE_OFFSET, place.y - BADGE_OFFSET);
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
    strokeTwice(context, "#ffb02e", 2.2);
  }
}
