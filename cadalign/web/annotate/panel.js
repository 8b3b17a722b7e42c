// The lower half: what the alignment is, what to mark next, and the list of pairs.
import { button, element } from "./dom.js";

export class Panel {
  /** @param {object} handlers - act(action), select(pair), suggested() */
  constructor(handlers) {
    this.handlers = handlers;
    this.alignment = element("div", { className: "alignment" });
    this.focal = this.makeFocal();
    this.advice = element("div", { className: "advice" });
    this.keypoints = element("ul", { className: "keypoints" });
    this.keypointsTitle = element("summary");
    this.details = element("details", {}, this.keypointsTitle, this.keypoints);
    this.rows = element("tbody");
    this.root = element(
      "section",
      { className: "panel", "aria-label": "Results" },
      card("Alignment", this.alignment, this.focal),
      card("Next keypoint", this.advice, this.details),
      card("Pairs", this.makeTable()),
    );
    this.root.lastChild.classList.add("wide");
  }

  show(state, selected) {
    this.showAlignment(state.alignment);
    this.showFocal(state.focal);
    this.showAdvice(state);
    this.showKeypoints(state.keypoints);
    this.showPairs(state.pairs, selected);
  }

  showAlignment(alignment) {
    if (alignment.status !== "done") {
      this.alignment.replaceChildren(element("p", { className: "soft" }, alignment.message));
      return;
    }
    const facts = alignment.facts.map(({ label, value, note }) =>
      element(
        "div",
        {},
        element("dt", {}, label),
        element("dd", {}, element("strong", {}, value), note ? element("span", {}, note) : null),
      ),
    );
    const notes = alignment.notes.map((note) => element("li", {}, note));
    this.alignment.replaceChildren(
      element("dl", { className: "facts" }, facts),
      notes.length ? element("ul", { className: "notes" }, notes) : "",
    );
  }

  makeFocal() {
    const choose = () => this.chooseFocal();
    this.estimate = element("input", { type: "radio", name: "focal", id: "focal-estimate", onchange: choose });
    this.known = element("input", { type: "radio", name: "focal", id: "focal-known", onchange: choose });
    this.pixels = element("input", {
      type: "number", min: "1", step: "any", inputMode: "decimal", "aria-label": "Focal length in pixels", onchange: choose,
    });
    this.note = element("p", { className: "soft" });
    return element(
      "fieldset",
      { className: "focal" },
      element("legend", {}, "Focal length"),
      element("label", {}, this.estimate, " unknown: estimate it"),
      element("label", {}, this.known, " known: ", this.pixels, " px"),
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

  showAdvice({ suggestion, alignment }) {
    if (!suggestion) {
      const text =
        alignment.status === "done"
          ? "No other visible point would help."
          : "Mark the same place in the photo and on the model; either comes first. Four pairs give the first alignment.";
      this.advice.replaceChildren(element("p", { className: "soft" }, text));
      return;
    }
    this.advice.replaceChildren(
      element("p", {}, suggestion.text),
      element(
        "p",
        { className: "soft" },
        "It is marked by a dashed yellow ring on the model, and in the photo where it should be.",
      ),
      button("Use this model point", this.handlers.suggested, { title: "N" }),
    );
  }

  showKeypoints(keypoints) {
    const free = keypoints.filter((keypoint) => !keypoint.used);
    this.details.hidden = free.length === 0;
    this.keypointsTitle.textContent = `Keypoints of the model not yet marked (${free.length})`;
    this.keypoints.replaceChildren(
      ...free.map(({ keypoint, name }) =>
        element("li", {}, button(name, () => this.handlers.act({ do: "place_keypoint", keypoint }))),
      ),
    );
  }

  makeTable() {
    const head = ["Pair", "Name", "Photo", "Off by", ""].map((text) =>
      element("th", { scope: "col" }, text || element("span", { className: "visually-hidden" }, "Actions")),
    );
    this.empty = element("p", { className: "soft" }, "No pairs yet.");
    this.table = element("table", {}, element("thead", {}, element("tr", {}, head)), this.rows);
    return element("div", { className: "scroll" }, this.empty, this.table);
  }

  showPairs(pairs, selected) {
    this.empty.hidden = pairs.length > 0;
    this.table.hidden = pairs.length === 0;
    const focus = this.rows.contains(document.activeElement) ? document.activeElement.dataset.key : null;
    this.rows.replaceChildren(...pairs.flatMap((pair) => this.row(pair, pair.pair === selected)));
    if (focus) this.rows.querySelector(`[data-key="${focus}"]`)?.focus();
  }

  row(pair, selected) {
    const { act, select } = this.handlers;
    const number = button(String(pair.position), () => select(pair.pair), {
      className: pair.off === null ? "badge" : "badge wrong",
      "aria-pressed": String(selected),
      "aria-label": `Select pair ${pair.position}`,
      "data-key": `select ${pair.pair}`,
    });
    const row = element(
      "tr",
      { className: selected ? "selected" : "", onclick: (event) => event.target.closest("button, input") || select(pair.pair) },
      element("td", {}, number),
      element("td", { className: "name" }, this.name(pair)),
      element("td", { className: "number place" }, pair.uv ? pair.uv.map((value) => value.toFixed(1)).join(", ") : element("em", {}, "click the photo")),
      element("td", { className: "number" }, pair.residual ? `${Math.hypot(...pair.residual).toFixed(1)} px` : "–"),
      element(
        "td",
        { className: "actions" },
        pair.keypoint !== null && pair.uv
          ? button("Repick", () => act({ do: "release", pair: pair.pair }, pair.pair), {
              "aria-label": `Choose another model point for pair ${pair.position}`,
              title: "Choose another model point",
              "data-key": `release ${pair.pair}`,
            })
          : null,
        button("✕", () => act({ do: "delete", pair: pair.pair }), {
          "aria-label": `Delete pair ${pair.position}`, title: "Delete", "data-key": `delete ${pair.pair}`,
        }),
      ),
    );
    return pair.off === null ? [row] : [row, wrong(pair)];
  }

  name(pair) {
    if (pair.keypoint === null) return element("em", {}, "click the model");
    return element("input", {
      value: pair.name,
      maxLength: 80,
      spellcheck: false,
      "aria-label": `Name of pair ${pair.position}`,
      "data-key": `name ${pair.pair}`,
      onchange: (event) => this.handlers.act({ do: "rename", pair: pair.pair, name: event.target.value }),
    });
  }
}

function wrong(pair) {
  const text = `Pair ${pair.position} contradicts the others: ${pair.off.toFixed(0)} px off`;
  return element("tr", { className: "wrong" }, element("td", { colSpan: 5 }, text));
}

function card(title, ...content) {
  const id = `card-${title.toLowerCase().replaceAll(" ", "-")}`;
  return element(
    "section",
    { className: "card", "aria-labelledby": id },
    element("h2", { id }, title),
    content,
  );
}
