// The photos of a folder as thumbnails.
import { button, h } from "../common/dom.js";

export class WorkList {
  /** @param {object} handlers - go(number), tell(text) */
  constructor(handlers) {
    this.handlers = handlers;
    this.grid = h("ul", { class: "thumbs" });
    this.dialog = h(
      "dialog",
      { class: "worklist", "aria-labelledby": "worklist-title" },
      h("h2", { id: "worklist-title" }, "Photos"),
      h("p", {}, button("Close", () => this.dialog.close())),
      this.grid,
    );
    this.dialog.addEventListener("close", () => this.dialog.open || this.dialog.remove()); // open: shown anew
  }

  async open(current) {
    if (this.dialog.open) return;
    const response = await fetch("worklist");
    if (!response.ok) {
      this.handlers.tell(await response.text());
      return;
    }
    const photos = await response.json();
    this.grid.replaceChildren(...photos.map((photo) => this.card(photo, photo.number === current)));
    document.body.append(this.dialog);
    this.dialog.showModal();
    this.grid.querySelector("[aria-current] button")?.scrollIntoView({ block: "center" });
  }

  card({ number, name, pairs, rms }, isCurrent) {
    const quality = rms === null ? "" : `, ${rms.toFixed(1)} px`;
    const picture = h("img", { src: `thumbnail/${number}`, alt: "", loading: "lazy", width: 120, height: 90 });
    const made = button("", () => {
      this.dialog.close();
      this.handlers.go(number);
    });
    made.append(
      picture,
      h("span", { class: "name" }, name),
      h("span", { class: pairs ? "state begun" : "state" }, `${pairs} pairs${quality}`),
    );
    return h("li", { "aria-current": isCurrent ? "true" : null }, made);
  }
}
