// The first-run tour: three steps beside what they are about.
import { button, h } from "../common/dom.js";

const SEEN = "cadalign-tour-seen";
const STEPS = [
  ["section[aria-label=Photo]", "1. Mark a point in the photo", "Click a corner or tip of the object. The wheel zooms at the pointer, dragging pans, and L shows a loupe."],
  ["section[aria-label=Model]", "2. Mark the same point on the model", "Drag to turn it, or look from a side by 1 to 6; S held snaps to corners; then click the same place. Both clicks make a pair; either comes first."],
  ["section[aria-label=Results]", "3. From four pairs on it is aligned", "The model is drawn over the photo, with what is known of its pose and stretch. Drag points that are off. Everything is saved at once; ? lists all keys."],
];

export class Tour {
  constructor() {
    this.title = h("h2", { id: "tour-title" });
    this.text = h("p", { id: "tour-text" });
    this.next = button("Next", () => this.go(1));
    this.back = button("Back", () => this.go(-1));
    this.box = h(
      "div",
      { class: "tour", role: "dialog", "aria-labelledby": "tour-title", "aria-describedby": "tour-text", hidden: true },
      this.title,
      this.text,
      h("div", {}, this.back, " ", this.next, " ", button("Skip the tour", () => this.end())),
    );
    this.box.addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return;
      event.stopPropagation();
      this.end();
    });
    document.body.append(this.box);
  }

  /** Show it to those who have not seen it. */
  startOnce() {
    let seen = null;
    try {
      seen = localStorage.getItem(SEEN);
    } catch {
      seen = "1"; // nothing can be remembered: it would come every time
    }
    if (!seen) this.start();
  }

  start() {
    this.step = 0;
    this.show();
    this.next.focus({ preventScroll: true });
  }

  go(by) {
    this.step += by;
    if (this.step < STEPS.length) this.show();
    else this.end();
  }

  show() {
    const [target, title, text] = STEPS[this.step];
    for (const [selector] of STEPS) document.querySelector(selector).classList.toggle("toured", selector === target);
    this.title.textContent = title;
    this.text.textContent = text;
    this.back.disabled = this.step === 0;
    this.next.textContent = this.step === STEPS.length - 1 ? "Begin" : "Next";
    this.box.hidden = false;
  }

  end() {
    this.box.hidden = true;
    document.querySelector(".toured")?.classList.remove("toured");
    try {
      localStorage.setItem(SEEN, "1");
    } catch {
      // private windows
    }
  }
}
