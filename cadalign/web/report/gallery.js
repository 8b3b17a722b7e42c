// The gallery: only the cards in view exist, so that ten thousand cost no more than forty.
import { h } from "../common/dom.js";
import { foundWords, galleryForm } from "./filters.js";
import { quantity } from "./format.js";
import { overlay } from "./overlay.js";
import { keyOf } from "./payload.js";
import { FILTERS, criteria, select } from "./selection.js";
import { swatch } from "./swatch.js";

const WIDTH = 236; // what a card should have at least
const GAP = 16;
const LINES = 3; // at most so many methods' errors on a card
const WORDS = 62; // height of a card's words without the errors
const LINE = 22;
const PRINTED = 12;
const HEAD = 12; // cards that are always there
const DECIDES = [...FILTERS, "sort", "order", "seed", "hide", "hideruns"];

export class Gallery {
  constructor(report, state, { open }) {
    this.report = report;
    this.state = state;
    this.open = open;
    this.cards = new Map();
    this.list = h("ul", {
      class: "cards",
      "aria-label": "instances",
      onkeydown: (event) => this.step(event),
    });
    this.status = h("p", { class: "found", role: "status" });
    this.element = h(
      "section",
      { id: "gallery", "aria-labelledby": "gallery-title" },
      h("h2", { id: "gallery-title" }, "Gallery"),
      galleryForm(report, state),
      this.status,
      this.list,
      h("p", { class: "print-only note" }, `Printed: the first ${PRINTED}.`),
    );
    state.listen((names) => DECIDES.some((name) => names.has(name)) && this.update());
    addEventListener("scroll", () => this.ask(), { passive: true });
    new ResizeObserver(() => this.measure()).observe(this.list);
    addEventListener("beforeprint", () => this.print());
    addEventListener("afterprint", () => this.measure());
    this.update();
  }

  /** Find anew what is shown. */
  update() {
    this.found = select(this.report, this.state);
    this.chosen = criteria(this.report, this.state);
    for (const card of this.cards.values()) card.remove();
    this.cards.clear();
    this.status.textContent = this.found.length
      ? foundWords(this.found.length, this.report.instances.length)
      : "No instance passes these filters.";
    this.measure();
  }

  /** Lay the grid out by the width there is. */
  measure() {
    const width = this.list.clientWidth;
    if (!width) return;
    const lines = Math.min(Math.max(this.chosen.shown.length, 1), LINES + 1);
    this.columns = Math.max(Math.floor((width + GAP) / (WIDTH + GAP)), width < 500 ? 2 : 1);
    this.cardWidth = (width - GAP * (this.columns - 1)) / this.columns;
    this.cardHeight = Math.round(this.cardWidth * 0.75) + WORDS + LINE * lines;
    const rows = Math.ceil(this.found.length / this.columns);
    this.list.style.height = `${Math.max(rows * (this.cardHeight + GAP) - GAP, 0)}px`;
    for (const [index, card] of this.cards) this.place(card, index);
    this.draw();
  }

  ask() {
    this.asked ??= requestAnimationFrame(() => {
      this.asked = undefined;
      this.draw();
    });
  }

  /** Make the cards in view, and a screen's worth around it; drop the others. */
  draw() {
    if (!this.columns) return;
    const { top } = this.list.getBoundingClientRect();
    const height = this.cardHeight + GAP;
    const first = Math.floor((-top - innerHeight) / height) * this.columns;
    const last = Math.ceil((-top + 2 * innerHeight) / height) * this.columns;
    this.keep(Math.max(first, 0), Math.min(last, this.found.length));
  }

  /** The first cards stay too: who comes by the Tab key or a screen reader finds the rest by them. */
  keep(first, last) {
    const head = Math.min(HEAD, this.found.length);
    for (let index = 0; index < head; index++) this.card(index);
    for (const [index, card] of this.cards) {
      const wanted = index < head || (index >= first && index < last);
      if (!wanted && !card.contains(document.activeElement)) {
        card.remove();
        this.cards.delete(index);
      }
    }
    for (let index = first; index < last; index++) this.card(index);
  }

  /** The card at a place, made if it is not there; in the order of reading among the others. */
  card(index) {
    const there = this.cards.get(index);
    if (there) return there;
    const card = this.make(index);
    this.place(card, index);
    this.cards.set(index, card);
    const next = [...this.list.children].find((other) => Number(other.dataset.place) > index);
    this.list.insertBefore(card, next ?? null);
    return card;
  }

  place(card, index) {
    const x = (index % this.columns) * (this.cardWidth + GAP);
    const y = Math.floor(index / this.columns) * (this.cardHeight + GAP);
    card.style.cssText = `width: ${this.cardWidth}px; height: ${this.cardHeight}px; transform: translate(${x}px, ${y}px)`;
  }

  make(index) {
    const instance = this.found[index];
    const { model, category, keypoints, run } = instance;
    const target = { open: keyOf(instance), openrun: String(run) };
    const facts = [
      category,
      keypoints !== null && `${keypoints} keypoints`,
      this.report.runs.length > 1 && this.report.runs[run]?.name,
    ];
    return h(
      "li",
      { "data-place": index, "aria-posinset": index + 1, "aria-setsize": this.found.length },
      h(
        "a",
        {
          class: "card",
          href: this.state.fragment(target) || "#",
          onclick: (event) => {
            if (event.ctrlKey || event.metaKey || event.shiftKey) return;
            event.preventDefault();
            this.open(instance);
          },
        },
        this.picture(instance, index),
        h("span", { class: "name", title: model }, model),
        h("span", { class: "soft" }, facts.filter(Boolean).join(" \u00b7 ")),
        this.errors(instance),
      ),
    );
  }

  errors(instance) {
    const { shown, metric } = this.chosen;
    const tried = shown.filter(({ key }) => instance.rows.has(key));
    const lines = tried
      .slice(0, LINES)
      .map((method) =>
        h(
          "span",
          { class: "error" },
          swatch(this.report, method),
          h("span", { class: "method" }, method.label),
          this.report.failed(instance, method.key)
            ? h("span", { class: "failed" }, "failed")
            : h(
                "span",
                {},
                metric ? quantity(this.report.error(instance, method.key, metric.key), metric) : "",
              ),
        ),
      );
    if (tried.length > LINES)
      lines.push(h("span", { class: "soft" }, `and ${tried.length - LINES} more`));
    return lines;
  }

  picture(instance, index) {
    const source = this.report.thumb(instance);
    const frame = h("span", { class: "thumb" });
    const missing = () => frame.replaceChildren(h("span", { class: "soft" }, "no picture"));
    if (source) {
      // Those that always are there are printed, too, without having been in view.
      const loading = index < HEAD ? "eager" : "lazy";
      frame.append(
        h("img", { src: source, alt: "", loading, decoding: "async", onerror: missing }),
      );
    } else if (instance.exhibit >= 0) {
      this.sketch(instance, frame);
    } else {
      missing();
    }
    return frame;
  }

  /** Where there is no picture, the boxes and the keypoints alone still show what happened. */
  async sketch(instance, frame) {
    const exhibit = await this.report.exhibit(instance);
    if (!exhibit) return frame.replaceChildren(h("span", { class: "soft" }, "no picture"));
    const { key } = this.chosen.chosen ?? this.chosen.shown[0] ?? {};
    const estimate =
      exhibit.estimates?.find(({ method, rotation }) => method === key && rotation) ?? null;
    const drawing = overlay(exhibit, {
      picture: null,
      estimate,
      layers: new Set("gpk"),
      label: "",
    });
    drawing.setAttribute("aria-hidden", "true");
    frame.replaceChildren(drawing);
  }

  /** Arrow keys walk from card to card. */
  step(event) {
    const move = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -this.columns, ArrowDown: this.columns }[
      event.key
    ];
    const at = Number(event.target.closest("li")?.dataset.place);
    if (!move || Number.isNaN(at)) return;
    event.preventDefault();
    this.focus(Math.min(Math.max(at + move, 0), this.found.length - 1));
  }

  /** Bring a card into view and the focus to it. */
  focus(index) {
    if (!this.found[index]) return;
    const card = this.card(index);
    card.scrollIntoView({ block: "nearest" });
    card.firstElementChild.focus({ preventScroll: true });
    this.draw();
  }

  print() {
    this.keep(0, Math.min(PRINTED, this.found.length));
    for (const [index, card] of this.cards) card.classList.toggle("unprinted", index >= PRINTED);
  }
}
