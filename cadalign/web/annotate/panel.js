// The lower half: what the alignment is, what to mark next, and the list of pairs.
import { button, h } from "../common/dom.js";

export class Panel {
  /** @param {object} handlers - act(action), select(pair), suggested() */
  constructor(handlers) {
    this.handlers = handlers;
    this.alignment = h("div", { class: "alignment" });
    this.focal = this.makeFocal();
    this.advice = h("div", { class: "advice" });
    this.ranking = h("div", { class: "ranking" });
    this.keypoints = h("ul", { class: "keypoints" });
    this.keypointsTitle = h("summary");
    this.details = h("details", {}, this.keypointsTitle, this.keypoints);
    this.rows = h("tbody");
    this.root = h(
      "section",
      { class: "panel", "aria-label": "Results" },
      card("Alignment", this.alignment, this.focal),
      card("Next keypoint", this.advice, this.ranking, this.details),
      card("Pairs", this.makeTable()),
    );
    this.root.lastChild.classList.add("wide");
  }

  show(state, selected) {
    this.showAlignment(state.alignment);
    this.showFocal(state.focal, state.shape);
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
    this.alignment.replaceChildren(
      h("dl", { class: "facts" }, facts),
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
    this.unknown = h("span");
    return h(
      "fieldset",
      { class: "focal" },
      h("legend", {}, "Focal length"),
      h("label", {}, this.estimate, this.unknown),
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

  showFocal({ known, pixels, typed, note }, shape) {
    this.unknown.textContent = shape ? " unknown: assume it" : " unknown: estimate it";
    this.known.checked = known;
    this.estimate.checked = !known;
    this.typedPixels = typed;
    this.shownPixels = pixels;
    if (document.activeElement !== this.pixels) this.pixels.value = pixels;
    this.pixels.disabled = !known;
    this.note.textContent = note;
    this.note.hidden = !note;
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

  /** Show what could be added, the most useful first; one that is out of date keeps its place. */
  showRanking(ranked, current) {
    this.ranking.classList.toggle("stale", !current);
    if (!current) return;
    const { pieces, note, now } = ranked;
    const rows = pieces.map(({ kind, what, left }) =>
      h("li", { class: `piece-${kind}` }, h("span", {}, what), ": ", h("strong", {}, left)),
    );
    this.ranking.replaceChildren(
      rows.length ? h("h3", {}, "What would help most") : "",
      rows.length ? h("p", { class: "soft" }, `The largest standard deviation, now ${now}, with each:`) : "",
      rows.length ? h("ol", {}, rows) : "",
      note ? h("p", { class: "soft" }, note) : "",
    );
  }

  showKeypoints(keypoints) {
    const free = keypoints.filter((keypoint) => !keypoint.used);
    this.details.hidden = free.length === 0;
    this.keypointsTitle.textContent = `Keypoints of the model not yet marked (${free.length})`;
    this.keypoints.replaceChildren(
      ...free.map(({ keypoint, name }) =>
        h("li", {}, button(name, () => this.handlers.act({ do: "place_keypoint", keypoint }))),
      ),
    );
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
    const number = button(String(pair.position), () => select(pair.pair), {
      class: pair.off === null ? "badge" : "badge wrong",
      "aria-pressed": String(selected),
      "aria-label": `Select pair ${pair.position}`,
      "data-key": `select ${pair.pair}`,
    });
    const row = h(
      "tr",
      { class: selected ? "selected" : "", onclick: (event) => event.target.closest("button, input") || select(pair.pair) },
      h("td", {}, number),
      h("td", { class: "name" }, this.name(pair)),
      h("td", { class: "number place" }, pair.uv ? pair.uv.map((value) => value.toFixed(1)).join(", ") : h("em", {}, "click the photo")),
      h("td", { class: "number" }, pair.residual ? `${Math.hypot(...pair.residual).toFixed(1)} px` : "–"),
      h(
        "td",
        { class: "actions" },
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
        "aria-label": `Keypoint of ${category} that pair ${pair.position} is`,
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
      "aria-label": `Name of pair ${pair.position}`,
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
  const text = `Pair ${pair.position} contradicts the others: ${pair.off.toFixed(0)} px off`;
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
