// What is known beside the pairs: a mask, vertical edges, lengths.
import { button, h } from "../common/dom.js";
import { readMask } from "./marking.js";

const AXES = { width: "x", height: "y", length: "z" };

export class EvidencePanel {
  /** @param {object} handlers - act(action), tell(text) */
  constructor({ act, tell }) {
    this.act = act;
    this.mask = h("span");
    this.gravity = h("span");
    this.photo = h("input", { type: "checkbox", onchange: () => act({ do: "use_photo", on: this.photo.checked }) });
    this.clearMask = button("Clear", () => act({ do: "mask_clear" }), { "aria-label": "Clear the mask" });
    this.clearGravity = button("Clear", () => act({ do: "gravity_clear" }), { "aria-label": "Clear the vertical edges" });
    const file = h("input", {
      type: "file", accept: "image/png", class: "visually-hidden", tabindex: "-1", "aria-label": "Mask file",
      onchange: () => this.load(file, tell),
    });
    this.lengths = Object.entries(AXES).map(([name, axis]) => this.number(`Known ${name} (along ${axis})`, name, axis));
    this.sigma = this.number("Deviation of the lengths in percent", "sigma", "");
    this.count = button("", () => this.toggle(), { "aria-expanded": "false" });
    this.body = h(
      "div",
      { class: "evidence", hidden: true },
      h("div", {}, h("b", {}, "Mask "), button("From file…", () => file.click()), " ", this.clearMask, " ", this.mask, file),
      h("div", {}, h("b", {}, "Gravity "), this.clearGravity, " ", this.gravity),
      h(
        "div",
        { class: "lengths", title: "Lengths of the object along the model's axes, in any one unit" },
        h("b", {}, "Known size "),
        this.lengths.map(({ name, axis, input }) => h("label", {}, `${name} ${axis} `, input)),
        h("label", {}, "± ", this.sigma.input, " %"),
      ),
      h("p", { class: "soft" }, "A box for the mask and vertical edges are drawn in the photo: choose what is marked there."),
    );
    this.root = h(
      "div",
      {},
      h(
        "label",
        { class: "photo", title: "The model's outline is sought in the photo, by the colours about it (I)" },
        this.photo,
        " Fit to the photo itself",
      ),
      this.count,
      this.body,
    );
  }

  toggle() {
    this.body.hidden = !this.body.hidden;
    this.count.setAttribute("aria-expanded", String(!this.body.hidden));
  }

  number(label, name, axis) {
    const input = h("input", {
      type: "number", min: "0", step: "any", inputMode: "decimal", "aria-label": label, onchange: () => this.choose(),
    });
    return { name, axis, input };
  }

  choose() {
    const lengths = Object.fromEntries(
      this.lengths.map(({ name, input }) => [name, input.value === "" ? null : Number(input.value)]),
    );
    const percent = this.sigma.input.value;
    this.act({ do: "lengths", ...lengths, sigma: percent === "" ? null : Number(percent) / 100 });
  }

  async load(input, tell) {
    const [file] = input.files;
    input.value = "";
    if (!file) return;
    try {
      await this.act({ do: "mask_load", runs: await readMask(file, this.size) });
    } catch (error) {
      tell(error.message);
    }
  }

  show({ evidence, image }) {
    this.size = image;
    this.photo.checked = evidence.photo;
    const { mask, verticals, gravity, gravity_sigma: sigma, lengths, length_sigma: relative } = evidence;
    this.mask.textContent = mask === null ? "none" : "drawn";
    this.clearMask.disabled = mask === null;
    const edges = `${verticals.length} vertical edge${verticals.length === 1 ? "" : "s"}`;
    this.gravity.textContent = gravity
      ? `${verticals.length ? edges : "known"}${sigma === null ? "" : `, ± ${sigma}°`}`
      : verticals.length ? edges : "unknown";
    this.clearGravity.disabled = !gravity && !verticals.length;
    for (const { name, input } of this.lengths) fill(input, lengths[name]);
    fill(this.sigma.input, relative === null ? null : Number((100 * relative).toPrecision(6)));
    const known = Object.values(lengths).filter((value) => value !== null).length;
    const count = Number(mask !== null) + Number(gravity) + Number(known > 0);
    this.count.textContent = `Mask, gravity, known size${count ? ` (${count} used)` : ""}`;
  }
}

function fill(input, value) {
  if (document.activeElement !== input) input.value = value ?? "";
}
