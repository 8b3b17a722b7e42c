// Evidence beside the pairs: the photo itself, or a mask.
import { button, h } from "../common/dom.js";

export class EvidencePanel {
  /** @param {object} handlers - act(action) */
  constructor({ act }) {
    this.photo = h("input", { type: "checkbox", onchange: () => act({ do: "use_photo", on: this.photo.checked }) });
    this.clear = button("Clear", () => act({ do: "mask_clear" }), { "aria-label": "Clear the mask" });
    this.mask = h("div", { class: "evidence" }, h("b", {}, "Mask "), this.clear);
    this.root = h(
      "div",
      {},
      h(
        "label",
        { class: "photo", title: "The model's outline is sought in the photo, by the colours about it (I)" },
        this.photo,
        " Fit to the photo itself",
      ),
      this.mask,
    );
  }

  show({ evidence }) {
    this.photo.checked = evidence.photo;
    this.mask.hidden = evidence.mask === null;
  }
}
