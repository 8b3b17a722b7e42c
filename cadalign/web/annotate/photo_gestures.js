// Mouse, touch and pen on the photo: click to place, drag to move or pan, wheel and pinch to zoom.

const CLICK_REACH = 4; // a press that moves no farther is a click
const WHEEL = 0.0016;

export class PhotoGestures {
  constructor(view) {
    this.view = view;
    this.pointers = new Map();
    this.press = null;
    const { canvas } = view;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointerleave", () => this.point(null));
    canvas.addEventListener("pointercancel", (event) => this.cancel(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  /** Where an event is in the view. */
  place(event) {
    const { left, top } = this.view.canvas.getBoundingClientRect();
    return { x: event.clientX - left, y: event.clientY - top };
  }

  /** Tell the loupe where the pointer is. */
  point(place) {
    const { loupe } = this.view;
    loupe.pointer = place;
    if (loupe.on) this.view.invalidate();
  }

  /** The pixel of the photo at a place of the view, or the nearest one. */
  pixel(place) {
    return this.view.clamp(this.view.toPixel(place));
  }

  down(event) {
    const place = this.place(event);
    this.view.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, place);
    if (this.pointers.size > 1) {
      this.view.dragged = null;
      this.view.marking.cancel();
      this.press = null;
      return;
    }
    const marks = event.button === 0 && this.view.marking.active;
    if (marks) this.view.marking.press(this.pixel(place));
    const pair = event.button === 0 && !marks ? this.view.pairAt(place) : null;
    // The point does not jump to the pointer: it keeps its distance.
    const own = pair && this.view.toView(pair.uv);
    const grip = own && { x: own.x - place.x, y: own.y - place.y };
    this.press = { start: place, marks, pair, grip, moved: false, button: event.button };
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    const place = this.place(event);
    this.point(place);
    if (!before) {
      const { marking } = this.view;
      if (marking.active) marking.follow(this.pixel(place));
      this.view.canvas.style.cursor = !marking.active && this.view.pairAt(place) ? "grab" : "crosshair";
      return;
    }
    if (this.pointers.size === 2) this.pinch(event.pointerId, before, place);
    this.pointers.set(event.pointerId, place);
    const { press } = this;
    if (!press) return;
    const gap = Math.hypot(place.x - press.start.x, place.y - press.start.y);
    press.moved ||= gap > CLICK_REACH;
    if (!press.moved) return;
    if (press.marks) {
      this.view.marking.drag(this.pixel(place));
      return;
    }
    if (press.pair) this.drag(place, false);
    else this.view.pan(place.x - before.x, place.y - before.y);
  }

  up(event) {
    const place = this.place(event);
    this.pointers.delete(event.pointerId);
    const { press, view } = this;
    this.press = null;
    if (!press) return;
    if (press.marks) {
      view.marking.release(this.pixel(place), press.moved);
    } else if (press.moved) {
      if (press.pair) {
        this.press = press;
        this.drag(place, true);
        this.press = null;
      }
    } else if (press.pair) {
      view.handlers.onSelect(press.pair.pair);
    } else if (press.button === 0) {
      const uv = view.toPixel(press.start);
      if (view.contains(uv)) view.handlers.onPlace(uv);
    }
  }

  cancel(event) {
    this.pointers.delete(event.pointerId);
    this.press = null;
    this.view.dragged = null;
    this.view.invalidate();
  }

  drag(place, done) {
    const { pair, grip } = this.press;
    const uv = this.view.clamp(this.view.toPixel({ x: place.x + grip.x, y: place.y + grip.y }));
    this.view.dragged = { pair: pair.pair, uv };
    this.view.invalidate();
    this.view.handlers.onMove(pair.pair, uv, done);
  }

  pinch(moving, before, place) {
    const [other] = [...this.pointers].filter(([id]) => id !== moving).map(([, at]) => at);
    const was = Math.hypot(before.x - other.x, before.y - other.y);
    const is = Math.hypot(place.x - other.x, place.y - other.y);
    if (was < 1 || is < 1) return;
    this.view.zoom(is / was, { x: (place.x + other.x) / 2, y: (place.y + other.y) / 2 });
    this.view.pan((place.x - before.x) / 2, (place.y - before.y) / 2);
  }

  wheel(event) {
    event.preventDefault();
    // Lines or pages instead of pixels; a pinch on a touchpad comes as a wheel with the control key.
    const unit = [1, 16, 400][event.deltaMode];
    const speed = event.ctrlKey ? 5 * WHEEL : WHEEL;
    this.view.zoom(Math.exp(-event.deltaY * unit * speed), this.place(event));
  }
}
