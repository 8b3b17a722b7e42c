// A magnified square beside the pointer, over the photo and over the model.
import { h } from "../common/dom.js";

const SIDE = 132; // [px]
const GAP = 26; // from the pointer
const ZOOM = 5; // over what the view shows
const LEAST_PIXEL = 6; // a pixel of the photo is shown at least so large

/** The border and the cross hair; what is inside is drawn by the view. */
export class Loupe {
  constructor(host) {
    this.on = false;
    this.pointer = null;
    this.frame = h("div", { class: "loupe", hidden: true, "aria-hidden": "true" });
    this.frame.style.width = this.frame.style.height = `${SIDE}px`;
    this.host = host;
    host.append(this.frame);
  }

  /** Where it is shown, or null: a square that the pointer does not cover. */
  place() {
    const shown = this.on && this.pointer !== null;
    this.frame.hidden = !shown;
    if (!shown) return null;
    const { clientWidth: width, clientHeight: height } = this.host;
    const { x, y } = this.pointer;
    const left = x + GAP + SIDE < width ? x + GAP : Math.max(0, x - GAP - SIDE);
    const top = y - GAP - SIDE > 0 ? y - GAP - SIDE : Math.min(y + GAP, Math.max(0, height - SIDE));
    this.frame.style.transform = `translate(${left}px, ${top}px)`;
    return { left, top, x, y };
  }
}

/** Draw what the loupe shows of a photo into its view's context. */
export function drawPhotoLoupe(view, { left, top, x, y }) {
  const { context, picture, scale, offset } = view;
  const zoom = Math.max(ZOOM, LEAST_PIXEL / scale);
  context.save();
  context.beginPath();
  context.rect(left, top, SIDE, SIDE);
  context.clip();
  context.fillStyle = "#808080";
  context.fillRect(left, top, SIDE, SIDE);
  // The place under the pointer stays at the middle of the square.
  context.translate(left + SIDE / 2 - zoom * x, top + SIDE / 2 - zoom * y);
  context.scale(zoom, zoom);
  context.imageSmoothingEnabled = false;
  const { width, height } = view.size;
  context.drawImage(picture, offset.x - scale / 2, offset.y - scale / 2, width * scale, height * scale);
  context.restore();
}

/** Render what the loupe shows of a stage, over its picture; `hidden` is left out. */
export function renderLoupe(stage, hidden, { left, top, x, y }) {
  const { renderer, scene, camera, host } = stage;
  const { clientWidth: width, clientHeight: height } = host;
  const span = SIDE / ZOOM;
  const { visible } = hidden;
  hidden.visible = false;
  camera.setViewOffset(width, height, x - span / 2, y - span / 2, span, span);
  renderer.setScissorTest(true);
  renderer.setViewport(left, height - top - SIDE, SIDE, SIDE);
  renderer.setScissor(left, height - top - SIDE, SIDE, SIDE);
  renderer.render(scene, camera);
  renderer.setScissorTest(false);
  renderer.setViewport(0, 0, width, height);
  camera.clearViewOffset();
  hidden.visible = visible;
}
