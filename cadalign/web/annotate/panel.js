// The lower part: what the alignment is, what else counts beside the pairs, and the list of pairs.
import { button, h } from "../common/dom.js";

export class Panel {
  /** @param {object} handlers - act(action, selected), select(pair) */
  constructor(handlers) {
    this.handlers = handlers;
    this.facts = h("dl", { class: "facts" });
    this.notes = h("ul", { class: "notes" });
    this.rows = h("ol", { class: "pairs" });
    this.title = h("h2", {}, "Pairs");
    this.root = h(
      "section",
      { class: "panel", "aria-label": "Results" },
      h("section", { class: "card" }, h("h2", {}, "Alignment"), this.facts, this.notes),
      h("section", { class: "card" }, h("h2", {}, "Evidence"), this.makeCategory(), this.makeEvidence()),
      h("section", { class: "card" }, this.title, this.rows),
    );
  }

  show(state, selected) {
    this.showAlignment(state.alignment);
    this.showCategory(state.model);
    this.showEvidence(state);
    this.free = state.keypoints.filter(({ used }) => !used);
    this.showPairs(state, selected);
  }

  /** The first of the notes stands beside the photo. */
  showAlignment({ facts = [], notes = [] }) {
    const fact = ({ label, value, note }) => h("div", {}, h("dt", {}, label), h("dd", {}, h("strong", {}, value), " ", note));
    this.facts.replaceChildren(...facts.map(fact));
    this.notes.replaceChildren(...notes.slice(1).map((note) => h("li", {}, note)));
  }

  /** The category of the object, without a model. */
  makeCategory() {
    const change = () => this.handlers.act({ do: "category", name: this.category.value });
    this.category = h("select", { onchange: change });
    const title = "Of the object in this photo. Pairs of keypoints with the same name stay";
    this.categories = h("label", { title }, "Category: ", this.category);
    return this.categories;
  }

  showCategory({ key, categories }) {
    this.categories.hidden = !categories.length;
    if (this.category.children.length !== categories.length) {
      this.category.replaceChildren(...categories.map((name) => h("option", {}, name)));
    }
    this.category.value = key;
  }

  makeEvidence() {
    const { act } = this.handlers;
    const choose = () => act({ do: "focal", pixels: this.known.checked ? Number(this.pixels.value) : null });
    this.estimated = h("input", { type: "radio", name: "focal", onchange: choose });
    this.known = h("input", { type: "radio", name: "focal", onchange: choose });
    this.pixels = h("input", { type: "number", min: "1", step: "any", "aria-label": "Focal length in pixels", onchange: choose });
    this.about = h("span", { class: "soft" });
    this.photo = h("input", { type: "checkbox", onchange: () => act({ do: "use_photo", on: this.photo.checked }) });
    this.mask = h("p", {}, "A mask is drawn. ", button("Clear", () => act({ do: "mask_clear" }), { "aria-label": "Clear the mask" }));
    this.also = h("p", { class: "soft" });
    this.outline = h(
      "label",
      { title: "The model's outline is sought in the photo, by the colours about it (I)" },
      this.photo,
      " Fit to the photo itself",
    );
    return [
      h(
        "fieldset",
        {},
        h("legend", {}, "Focal length"),
        h("label", {}, this.known, " known: ", this.pixels, " px"),
        h("label", {}, this.estimated, " estimated; at first ", this.about),
      ),
      this.outline,
      this.mask,
      this.also,
    ];
  }

  showEvidence({ focal, evidence, alignment }) {
    this.known.checked = focal.known;
    this.estimated.checked = !focal.known;
    if (document.activeElement !== this.pixels) this.pixels.value = focal.pixels;
    this.pixels.disabled = !focal.known;
    this.about.textContent = focal.prior;
    this.photo.checked = evidence.photo;
    this.outline.hidden = !evidence.outline;
    this.mask.hidden = evidence.mask === null;
    this.also.textContent = alignment.also_used ? `Also used: ${alignment.also_used}` : "";
  }

  /** The choice of a pair's keypoint, by name. */
  choice(pair) {
    const options = this.free.map(({ keypoint, name }) => h("option", { value: keypoint }, name));
    const act = () => this.handlers.act({ do: "place_keypoint", keypoint: Number(choice.value), pair });
    const label = "Keypoints of the model that are not marked";
    const choice = h("select", { "aria-label": label, onchange: act }, h("option", { value: "" }, "click the model or choose"), options);
    return choice;
  }

  showPairs({ pairs, shape, model }, selected) {
    this.isFixed = model.is_skeleton;
    this.title.textContent = pairs.length ? `Pairs (${pairs.length})` : "Pairs: none yet";
    const key = this.rows.contains(document.activeElement) ? document.activeElement.dataset.key : null;
    this.rows.replaceChildren(...pairs.map((pair) => this.row(pair, shape, pair.pair === selected)));
    if (key) this.rows.querySelector(`[data-key="${key}"]`)?.focus();
  }

  row(pair, shape, selected) {
    const { act, select } = this.handlers;
    const { pair: number, uv, keypoint, off, residual } = pair;
    const does = (text, label, name, onclick) =>
      button(text, onclick, { "aria-label": `${label} pair ${number}`, title: label.split(" ")[0], "data-key": `${name} ${number}` });
    const repick = () => act({ do: "release", pair: number }, number);
    const length = off ?? (residual ? Math.hypot(...residual) : null);
    return h(
      "li",
      { class: selected ? "selected" : "", onclick: (event) => event.target.closest("button, input, select") || select(number) },
      button(String(number), () => select(number), {
        class: off === null ? "badge" : "badge off",
        "aria-pressed": String(selected),
        "aria-label": `Select pair ${number}`,
        "data-key": `select ${number}`,
      }),
      this.name(pair),
      uv === null && h("span", { class: "number pending" }, "click the photo"),
      uv !== null && keypoint !== null && [
        h("span", { class: off === null ? "number" : "number wrong" }, length === null ? "" : `${length.toFixed(1)} px`),
        does("↺", "Repick the model point of", "release", repick),
      ],
      does("✕", "Delete", "delete", () => act({ do: "delete", pair: number })),
      pair.counts || !shape?.category ? null : this.identity(pair, shape),
    );
  }

  name({ pair, keypoint, name }) {
    if (keypoint === null) return h("span", { class: "choice" }, this.free.length ? this.choice(pair) : "click the model");
    if (this.isFixed) return h("span", { class: "name", title: name }, name);
    return h("input", {
      value: name,
      maxLength: 80,
      spellcheck: "false",
      "aria-label": `Name of pair ${pair}`,
      "data-key": `name ${pair}`,
      onchange: (event) => this.handlers.act({ do: "rename", pair, name: event.target.value }),
    });
  }

  /** The choice which keypoint of the shape a model point is that it does not know. */
  identity({ pair }, { category, missing }) {
    const option = (text, value) => h("option", { value }, text);
    const choice = h(
      "select",
      {
        onchange: () => choice.value && this.handlers.act({ do: "identify", pair, label: missing[choice.value] }),
        "aria-label": `Keypoint of ${category} that pair ${pair} is`,
        "data-key": `identify ${pair}`,
      },
      option("choose one", ""),
      missing.map((label, at) => option(typeof label === "string" ? label : `keypoint ${label}`, at)),
    );
    return h("p", { class: "soft" }, `Does not count yet. Keypoint of ${category}: `, choice);
  }
}
