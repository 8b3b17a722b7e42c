// The gallery: cards of instances, shown in batches.
import { button, h } from "../common/dom.js";
import { galleryForm } from "./filters.js";
import { count, plural, quantity } from "./format.js";
import { overlay } from "./overlay.js";
import { keyOf } from "./payload.js";
import { FILTERS, criteria, select } from "./selection.js";
import { swatch } from "./swatch.js";

const LINES = 3; // most methods whose errors are on a card
const AT_A_TIME = 48;
const DECIDES = [...FILTERS, "sort", "order", "hide", "hideruns"];

export class Gallery {
  constructor(report, state, { open }) {
    this.report = report;
    this.state = state;
    this.open = open;
    this.list = h("ul", { class: "cards", "aria-label": "instances" });
    this.status = h("p", { class: "found", role: "status" });
    this.more = button("Show more", () => this.extend(), { class: "quiet" });
    this.element = h(
      "section",
      { id: "gallery", "aria-labelledby": "gallery-title" },
      h("h2", { id: "gallery-title" }, "Gallery"),
      galleryForm(report, state),
      this.status,
      this.list,
      this.more,
    );
    state.listen((names) => DECIDES.some((name) => names.has(name)) && this.update());
    this.update();
  }

  /** Select the instances and show the first batch. */
  update() {
    this.found = select(this.report, this.state);
    this.chosen = criteria(this.report, this.state);
    const all = this.report.instances.length;
    const [found, words] = [this.found.length, plural(this.found.length, "instance")];
    const some = found === all ? words : `${words} of ${count(all)}`;
    this.status.textContent = found ? some : "No instance passes these filters.";
    this.list.replaceChildren();
    this.extend();
  }

  extend() {
    const there = this.list.children.length;
    this.list.append(
      ...this.found.slice(there, there + AT_A_TIME).map((instance) => this.card(instance)),
    );
    this.more.hidden = this.list.children.length >= this.found.length;
  }

  card(instance) {
    const { model, category, keypoints, run } = instance;
    const target = { open: keyOf(instance), openrun: String(run) };
    const facts = [
      category,
      keypoints !== null && `${keypoints} keypoints`,
      this.report.runs.length > 1 && this.report.runs[run]?.name,
    ];
    const onclick = (event) => {
      if (event.ctrlKey || event.metaKey || event.shiftKey) return;
      event.preventDefault();
      this.open(instance);
    };
    return h(
      "li",
      {},
      h(
        "a",
        { class: "card", href: this.state.fragment(target) || "#", onclick },
        this.picture(instance),
        h("span", { class: "name", title: model }, model),
        h("span", { class: "soft" }, facts.filter(Boolean).join(" \u00b7 ")),
        this.errors(instance),
      ),
    );
  }

  errors(instance) {
    const { shown, metric } = this.chosen;
    const tried = shown.filter(({ key }) => instance.rows.has(key));
    const value = (key) =>
      metric ? quantity(this.report.error(instance, key, metric.key), metric) : "";
    const lines = tried.slice(0, LINES).map((method) =>
      h(
        "span",
        { class: "error" },
        swatch(this.report, method),
        h("span", { class: "method" }, method.key),
        this.report.failed(instance, method.key)
          ? h("span", { class: "failed" }, "failed")
          : h("span", {}, value(method.key)),
      ),
    );
    const rest = tried.length - LINES;
    return rest > 0 ? [...lines, h("span", { class: "soft" }, `and ${rest} more`)] : lines;
  }

  /** A picture, or boxes and keypoints without one. */
  picture(instance) {
    const source = this.report.thumb(instance);
    if (source) {
      return h("span", { class: "thumb" }, h("img", { src: source, alt: "", loading: "lazy" }));
    }
    const exhibit = this.report.exhibit(instance);
    if (!exhibit) return h("span", { class: "thumb soft" }, "no picture");
    const { key } = this.chosen.methods[0] ?? {};
    const estimate =
      exhibit.estimates?.find(({ method, rotation }) => method === key && rotation) ?? null;
    const layers = new Set("gpk");
    const drawing = overlay(exhibit, { picture: null, estimate, layers, label: "" });
    drawing.setAttribute("aria-hidden", "true");
    return h("span", { class: "thumb" }, drawing);
  }
}
