// The lower half: what the alignment is, what to mark next, and the list of pairs.
import { button, h } from "../common/dom.js";
import { EvidencePanel } from "./evidence_panel.js";

export class Panel {
  /** @param {object} handlers - act(action), select(pair), suggested() */
  constructor(handlers) {
    this.handlers = handlers;
    this.alignment = h("div", { class: "alignment" });
    this.focal = this.makeFocal();
    this.priors = this.makePriors();
    this.evidence = new EvidencePanel(handlers);
    this.advice = h("div", { class: "advice" });
    this.keypoints = h("ul", { class: "keypoints" });
    this.keypointsTitle = h("summary");
    this.listed = new Set(); // keypoints in the list
    this.details = h("details", { class: "keypoints-list" }, this.keypointsTitle, this.keypoints);
    this.rows = h("tbody");
    this.root = h(
      "section",
      { class: "panel", "aria-label": "Results" },
      card("Alignment", this.focal, this.priors, this.evidence.root, this.alignment),
      card("Next keypoint", this.details, this.advice),
      card("Pairs", this.makeTable()),
    );
  }

  show(state, selected) {
    this.showAlignment(state.alignment);
    this.showFocal(state.focal);
    this.showPriors(state.priors);
    this.evidence.show(state);
    this.showAdvice(state);
    this.showKeypoints(state.keypoints);
    this.showPairs(state, selected);
  }

  showAlignment(alignment) {
    if (alignment.status !== "done") {
      this.alignment.replaceChildren(h("p", { class: "soft" }, alignment.message));
      return;
    }
    const facts = alignment.facts.map(({ label, value, note }) =>
      h(
        "div",
        {},
        h("dt", {}, label),
        h("dd", {}, h("strong", {}, value), note ? h("span", {}, note) : null),
      ),
    );
    const notes = alignment.notes.map((note) => h("li", {}, note));
    const { also_used: also } = alignment;
    this.alignment.replaceChildren(
      h("dl", { class: "facts" }, facts),
      also ? h("p", { class: "also" }, `Also used: ${also}`) : "",
      notes.length ? h("ul", { class: "notes" }, notes) : "",
    );
  }

  makeFocal() {
    const choose = () => this.chooseFocal();
    this.estimate = h("input", { type: "radio", name: "focal", id: "focal-estimate", onchange: choose });
    this.known = h("input", { type: "radio", name: "focal", id: "focal-known", onchange: choose });
    this.pixels = h("input", {
      type: "number", min: "1", step: "any", inputMode: "decimal", "aria-label": "Focal length in pixels", onchange: choose,
    });
    this.note = h("p", { class: "soft" });
    return h(
      "fieldset",
      { class: "focal" },
      h("legend", {}, "Focal length"),
      h("label", {}, this.estimate, " estimate it"),
      h("label", {}, this.known, " known: ", this.pixels, " px"),
      this.note,
    );
  }

  chooseFocal() {
    const known = this.known.checked;
    const pixels = Number(this.pixels.value);
    const typed = Number.isFinite(pixels) && pixels > 0 && pixels !== this.shownPixels;
    this.handlers.act({ do: "focal", known, pixels: typed ? pixels : this.typedPixels ?? null });
  }

  showFocal({ known, pixels, typed, note }) {
    this.known.checked = known;
    this.estimate.checked = !known;
    this.typedPixels = typed;
    this.shownPixels = pixels;
    if (document.activeElement !== this.pixels) this.pixels.value = pixels;
    this.pixels.disabled = !known;
    this.note.textContent = note;
    this.note.hidden = !note;
  }

  makePriors() {
    const choose = () => this.choosePriors();
    this.hasStretch = h("input", { type: "checkbox", onchange: choose });
    this.stretch = h("input", {
      type: "number", min: "1", max: "200", step: "any", inputMode: "decimal",
      "aria-label": "Standard deviation of the stretch about 1, in percent", onchange: choose,
    });
    this.hasFocal = h("input", { type: "checkbox", onchange: choose });
    this.about = h("span");
    this.ofStretch = h("label", {}, this.hasStretch, " stretch 1 ± ", this.stretch, " %");
    this.ofFocal = h("label", {}, this.hasFocal, " focal length ", this.about);
    return h(
      "fieldset",
      { class: "focal priors", title: "They hold the result near the model as it is, and near usual lenses, until the pairs say otherwise" },
      h("legend", {}, "Assumed at first"),
      this.ofStretch,
      this.ofFocal,
    );
  }

  choosePriors() {
    const percent = Number(this.stretch.value) || this.likely;
    const stretch = this.hasStretch.checked ? percent / 100 : null;
    this.handlers.act({ do: "prior", stretch, focal: this.hasFocal.checked });
  }

  showPriors({ stretch, likely, focal, about, has_stretch: ofStretch, has_focal: ofFocal }) {
    this.likely = likely;
    this.hasStretch.checked = stretch !== null;
    if (document.activeElement !== this.stretch) this.stretch.value = stretch ?? likely;
    this.stretch.disabled = stretch === null;
    this.hasFocal.checked = focal;
    this.about.textContent = about;
    this.ofStretch.hidden = !ofStretch;
    this.ofFocal.hidden = !ofFocal;
    this.priors.hidden = !ofStretch && !ofFocal;
  }

  showAdvice({ suggestion, alignment, shape }) {
    if (!suggestion) {
      const text =
        alignment.status === "done"
          ? nothingLeft(shape)
          : `Mark the same place in the photo and on the model; either comes first. ${shape ? "Three" : "Four"} pairs give the first alignment.`;
      this.advice.replaceChildren(h("p", { class: "soft" }, text));
      return;
    }
    this.advice.replaceChildren(
      h("p", {}, suggestion.text),
      h(
        "p",
        { class: "soft" },
        "It is marked by a dashed yellow ring on the model, and in the photo where it should be.",
      ),
      button("Use this model point", this.handlers.suggested, { title: "N" }),
    );
  }

  /** The keypoints that can be marked; one that is marked keeps its place among them. */
  showKeypoints(keypoints) {
    const free = keypoints.filter((keypoint) => !keypoint.used);
    for (const { keypoint } of free) this.listed.add(keypoint);
    this.keypointsTitle.textContent = `Keypoints of the model not yet marked (${free.length})`;
    const focus = this.keypoints.contains(document.activeElement) ? document.activeElement.dataset.key : null;
    this.keypoints.replaceChildren(
      ...keypoints.filter(({ keypoint }) => this.listed.has(keypoint)).map(({ keypoint, name, used }) =>
        h("li", {}, button(name, () => this.handlers.act({ do: "place_keypoint", keypoint }), { disabled: used, "data-key": keypoint })),
      ),
    );
    if (focus) this.keypoints.querySelector(`[data-key="${focus}"]`)?.focus();
  }

  makeTable() {
    const head = ["Pair", "Name", "Photo", "Off by", ""].map((text) =>
      h("th", { scope: "col" }, text || h("span", { class: "visually-hidden" }, "Actions")),
    );
    this.empty = h("p", { class: "soft" }, "No pairs yet.");
    this.table = h("table", {}, h("thead", {}, h("tr", {}, head)), this.rows);
    return h("div", { class: "scroll" }, this.empty, this.table);
  }

  showPairs({ pairs, shape }, selected) {
    this.empty.hidden = pairs.length > 0;
    this.table.hidden = pairs.length === 0;
    const focus = this.rows.contains(document.activeElement) ? document.activeElement.dataset.key : null;
    this.rows.replaceChildren(...pairs.flatMap((pair) => this.row(pair, shape, pair.pair === selected)));
    if (focus) this.rows.querySelector(`[data-key="${focus}"]`)?.focus();
  }

  row(pair, shape, selected) {
    const { act, select } = this.handlers;
    const number = button(String(pair.pair), () => select(pair.pair), {
      class: pair.off === null ? "badge" : "badge wrong",
      "aria-pressed": String(selected),
      "aria-label": `Select pair ${pair.pair}`,
      "data-key": `select ${pair.pair}`,
    });
    const row = h(
      "tr",
      { class: selected ? "selected" : "", onclick: (event) => event.target.closest("button, input") || select(pair.pair) },
      h("td", {}, number),
      h("td", { class: "name" }, this.name(pair)),
      h("td", { class: "number place" }, pair.uv ? pair.uv.map((value) => value.toFixed(1)).join(", ") : h("em", {}, "click the photo")),
      h("td", { class: "number residual" }, pair.residual ? `${Math.hypot(...pair.residual).toFixed(1)} px` : "–"),
      h(
        "td",
        { class: "actions" },
        pair.keypoint !== null && pair.uv
          ? button("Repick", () => act({ do: "release", pair: pair.pair }, pair.pair), {
              "aria-label": `Repick the model point of pair ${pair.pair}`,
              title: "Choose another model point",
              "data-key": `release ${pair.pair}`,
            })
          : null,
        button("✕", () => act({ do: "delete", pair: pair.pair }), {
          "aria-label": `Delete pair ${pair.pair}`, title: "Delete", "data-key": `delete ${pair.pair}`,
        }),
      ),
    );
    const notes = pair.off === null ? [] : [wrong(pair)];
    if (!pair.counts && shape.category) notes.push(this.identity(pair, shape));
    return [row, ...notes];
  }

  /** The choice which keypoint of the shape a model point is that it does not know. */
  identity(pair, { category, missing }) {
    const choose = (event) => {
      const label = missing[event.target.value];
      if (label !== undefined) this.handlers.act({ do: "identify", pair: pair.pair, label });
    };
    const option = (text, value) => h("option", { value }, text);
    const choice = h(
      "select",
      {
        onchange: choose,
        "aria-label": `Keypoint of ${category} that pair ${pair.pair} is`,
        "data-key": `identify ${pair.pair}`,
      },
      option("choose one", ""),
      missing.map((label, at) => option(typeof label === "string" ? label : `keypoint ${label}`, at)),
    );
    const text = `Does not count: no keypoint of ${category} is known here`;
    const ask = missing.length ? [". It is ", choice] : ".";
    return h("tr", { class: "aside" }, h("td", { colSpan: 5 }, text, ask));
  }

  name(pair) {
    if (pair.keypoint === null) return h("em", {}, "click the model");
    return h("input", {
      value: pair.name,
      maxLength: 80,
      spellcheck: "false",
      "aria-label": `Name of pair ${pair.pair}`,
      "data-key": `name ${pair.pair}`,
      onchange: (event) => this.handlers.act({ do: "rename", pair: pair.pair, name: event.target.value }),
    });
  }
}

/** Why no point is suggested. */
function nothingLeft(shape) {
  if (!shape) return "No other visible point would help.";
  if (!shape.category) return "Every further pair helps; best far from the others.";
  return `All visible keypoints of ${shape.category} that this model has are marked.`;
}

function wrong(pair) {
  const text = `Pair ${pair.pair} contradicts the others: ${pair.off.toFixed(0)} px off`;
  return h("tr", { class: "wrong" }, h("td", { colSpan: 5 }, text));
}

function card(title, ...content) {
  const id = `card-${title.toLowerCase().replaceAll(" ", "-")}`;
  return h(
    "section",
    { class: "card", "aria-labelledby": id },
    h("h2", { id }, title),
    content,
  );
}
