// The photos of a folder: thumbnails with their states, filtered.
import { button, h } from "../common/dom.js";

const STATES = ["to do", "begun", "done", "skipped"];

export class WorkList {
  /** @param {object} handlers - go(number), tell(text) */
  constructor(handlers) {
    this.handlers = handlers;
    this.photos = [];
    this.filter = h(
      "select",
      { "aria-label": "Photos to show and to go to", onchange: () => this.draw() },
      [h("option", { value: "" }), ...STATES.map((state) => h("option", { value: state }))],
    );
    this.grid = h("ul", { class: "thumbs" });
    this.dialog = h(
      "dialog",
      { class: "worklist", "aria-labelledby": "worklist-title" },
      h("h2", { id: "worklist-title" }, "Photos"),
      h("p", {}, this.filter, " ", button("Close", () => this.dialog.close())),
      this.grid,
    );
    this.dialog.addEventListener("close", () => this.dialog.open || this.dialog.remove()); // open: shown anew
  }

  async open(current) {
    if (this.dialog.open) return;
    await this.load();
    this.current = current;
    this.draw();
    document.body.append(this.dialog);
    this.dialog.showModal();
    this.grid.querySelector("[aria-current] button")?.scrollIntoView({ block: "center" });
  }

  async load() {
    const response = await fetch("worklist");
    if (!response.ok) this.handlers.tell(await response.text());
    else this.photos = await response.json();
  }

  /** The photo some places on, among those of the filter; null if there is none. */
  async next(from, by) {
    if (this.filter.value) await this.load();
    const { photos } = this;
    const step = Math.sign(by);
    for (let at = from + step; at >= 0 && at < photos.length; at += step) {
      if (this.isShown(photos[at])) return at;
    }
    return null;
  }

  isShown({ state }) {
    return !this.filter.value || state === this.filter.value;
  }

  draw() {
    const { photos } = this;
    const count = (state) => photos.filter((photo) => photo.state === state).length;
    for (const option of this.filter.options) {
      const { value } = option;
      option.textContent = value ? `${value} (${count(value)})` : `all (${photos.length})`;
    }
    this.grid.replaceChildren(...photos.filter((photo) => this.isShown(photo)).map((photo) => this.card(photo)));
  }

  card({ number, name, state, pairs, rms }) {
    const quality = rms === null ? "" : `, ${rms.toFixed(1)} px`;
    const picture = h("img", { src: `thumbnail/${number}`, alt: "", loading: "lazy", width: 120, height: 90 });
    const made = button("", () => {
      this.dialog.close();
      this.handlers.go(number);
    });
    made.append(
      picture,
      h("span", { class: "name" }, name),
      h("span", { class: `state ${state.replace(" ", "-")}` }, `${state} · ${pairs} pairs${quality}`),
    );
    return h("li", { "aria-current": number === this.current ? "true" : null }, made);
  }
}
