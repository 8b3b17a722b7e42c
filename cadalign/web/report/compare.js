// Two runs side by side: a paired plot, and the instances that changed most.
import { themeColor } from "../common/colors.js";
import { button, field, h } from "../common/dom.js";
import { layoutOf, plain } from "./chart.js";
import { methodOptions, metricOptions, runOptions, select } from "./filters.js";
import { named, plural, quantity } from "./format.js";
import { Panel } from "./plots.js";
import { pairs } from "./selection.js";

const PAGE = 12;
const DOTS = 2500; // more would only cover each other
const DECIDES = ["a", "b", "by", "with"];

export class Comparison {
  constructor(report, state, { open }) {
    this.report = report;
    this.state = state;
    this.open = open;
    this.shown = PAGE;
    this.list = h("ol", { class: "pairs" });
    this.status = h("p", { class: "found", role: "status" });
    this.more = button("Show more", () => this.extend(), { class: "quiet" });
    this.note = h("figcaption");
    const host = h("div", {
      class: "plot square",
      id: "plot-pairs",
      role: "img",
      "aria-label": "paired errors of two runs; the list beside it holds the same",
    });
    this.panel = new Panel(host, () => this.chart(), { square: true });
    this.element = h(
      "section",
      { id: "compare", "data-short": "Changes", "aria-labelledby": "compare-title" },
      h("h2", { id: "compare-title" }, "What changed between runs"),
      this.form(),
      this.status,
      h(
        "div",
        { class: "versus" },
        h("figure", { class: "panel" }, host, this.note),
        h("div", {}, this.list, this.more),
      ),
    );
    state.listen((names) => DECIDES.some((name) => names.has(name)) && this.update());
    this.update();
  }

  form() {
    const { report, state } = this;
    const runs = runOptions(report);
    return h(
      "form",
      {
        class: "filters",
        "aria-label": "what to compare",
        onsubmit: (event) => event.preventDefault(),
      },
      field("from", select(state, "a", runs)),
      field("to", select(state, "b", runs)),
      field("by", select(state, "by", metricOptions(report))),
      field("of", select(state, "with", methodOptions(report), { fallback: this.method().key })),
    );
  }

  /** The method compared: the one chosen, or the first that several runs have. */
  method() {
    const { report } = this;
    const chosen = report.fitted.find(({ key }) => key === this.state.get("with"));
    const runsOf = ({ key }) =>
      new Set(report.instances.filter((instance) => instance.rows.has(key)).map(({ run }) => run))
        .size;
    return chosen ?? report.fitted.find((method) => runsOf(method) > 1) ?? report.fitted[0];
  }

  failed(instance) {
    return this.report.failed(instance, this.method().key);
  }

  /** Whether nothing failed, but there are no two values to compare, as of a box without volume. */
  isUnknown({ a, b, before, after }) {
    return (before === null || after === null) && !this.failed(a) && !this.failed(b);
  }

  update() {
    const { report, state } = this;
    this.a = state.number("a") ?? 0;
    this.b = state.number("b") ?? 1;
    this.metric = report.metric.get(state.get("by")) ?? report.metrics[0];
    const method = this.method().key;
    this.pairs = pairs(report, { a: this.a, b: this.b, method, metric: this.metric });
    const worse = this.pairs.filter(({ change }) => change > 0).length;
    const better = this.pairs.filter(({ change }) => change < 0).length;
    const unknown = this.pairs.filter((pair) => this.isUnknown(pair)).length;
    this.status.textContent = this.pairs.length
      ? `${plural(this.pairs.length, "instance")} in both: ${better} better, ${worse} worse, ` +
        `${this.pairs.length - better - worse - unknown} the same` +
        (unknown ? `, ${unknown} without a value in both.` : ".")
      : "No instance is in both.";
    this.shown = PAGE;
    this.list.replaceChildren();
    this.extend(0);
    this.panel.refresh();
  }

  extend(by = PAGE) {
    const from = this.list.children.length;
    this.shown += by;
    this.list.append(...this.pairs.slice(from, this.shown).map((pair) => this.card(pair)));
    this.more.hidden = this.shown >= this.pairs.length;
  }

  card(pair) {
    const { change, a, b } = pair;
    const side = (instance, value) =>
      h(
        "span",
        { class: "side" },
        this.thumb(instance),
        h("span", { class: "soft" }, this.report.runs[instance.run].name),
        h("strong", {}, this.failed(instance) ? "failed" : quantity(value, this.metric)),
      );
    return h(
      "li",
      {},
      h(
        "button",
        { type: "button", class: "pair", onclick: () => this.openPair(pair) },
        h("span", { class: "sides" }, side(a, pair.before), side(b, pair.after)),
        h("span", { class: "name", title: a.model }, a.model),
        h(
          "span",
          { class: change > 0 ? "worse" : change < 0 ? "better" : "soft" },
          this.words(pair),
        ),
      ),
    );
  }

  /** What became of an instance. */
  words(pair) {
    const { change } = pair;
    if (this.isUnknown(pair)) return "nothing to compare";
    if (change === 0) return "= the same";
    const arrow = change > 0 ? "\u25b2" : "\u25bc";
    if (!Number.isFinite(change)) return `${arrow} ${change > 0 ? "now fails" : "no longer fails"}`;
    const by = quantity(Math.abs(change), this.metric);
    return `${arrow} ${change < 0 ? "better" : "worse"} by ${by}`;
  }

  thumb(instance) {
    const source = this.report.thumb(instance);
    return h(
      "span",
      { class: "thumb" },
      source
        ? h("img", { src: source, alt: "", loading: "lazy", decoding: "async" })
        : h("span", { class: "soft" }, "no picture"),
    );
  }

  openPair({ b, a }) {
    this.open(b, { beside: String(a.run), show: this.method().key });
  }

  chart() {
    const both = this.pairs.filter(({ before, after }) => before !== null && after !== null);
    const dots = both.slice(0, DOTS);
    const missing = this.pairs.length - both.length;
    this.note.textContent =
      "Below the line the second run is " +
      `${this.metric.better === "high" ? "worse" : "better"}. A click opens the instance.` +
      (missing ? ` Not drawn: ${plural(missing, "pair")} without two values.` : "") +
      (both.length > DOTS ? ` Drawn: the ${DOTS} that changed most.` : "");
    // On a logarithmic axis nothing is at zero.
    const positive = dots
      .flatMap(({ before, after }) => [before, after])
      .filter((value) => value > 0);
    const log = Boolean(this.metric.log) && positive.length > 0;
    const least = log ? positive.reduce((low, value) => Math.min(low, value), Infinity) : 0;
    const most =
      dots.reduce((high, { before, after }) => Math.max(high, before, after), log ? least : 0) || 1;
    const ends = log ? [least / 1.5, most * 1.5] : [0, most * 1.05];
    const range = log ? ends.map(Math.log10) : ends;
    const at = (value) => (log ? Math.max(value, least) : value);
    const group = (name, color, symbol, list) => ({
      x: list.map(({ before }) => at(before)),
      y: list.map(({ after }) => at(after)),
      text: list.map(({ a }) => plain(a.model)),
      customdata: list.map((pair) => this.pairs.indexOf(pair)),
      hovertemplate: "%{text}<br>%{x:.3~g} \u2192 %{y:.3~g}<extra></extra>",
      name,
      mode: "markers",
      marker: { color: themeColor(color), size: 8, symbol, opacity: 0.75 },
    });
    const axis = (run) => ({
      label: `${named(this.metric)}, ${this.report.runs[run]?.name ?? ""}`,
      log,
      range,
      values: ends,
    });
    return {
      traces: [
        {
          x: ends,
          y: ends,
          mode: "lines",
          line: { color: themeColor("soft"), width: 1, dash: "dot" },
          hoverinfo: "skip",
        },
        group(
          "worse",
          "est",
          "triangle-up",
          dots.filter(({ change }) => change > 0),
        ),
        group(
          "better or the same",
          "gt",
          "circle",
          dots.filter(({ change }) => change <= 0),
        ),
      ],
      layout: layoutOf({ x: axis(this.a), y: axis(this.b) }, { hovermode: "closest" }),
      click: ({ points }) =>
        points[0]?.customdata !== undefined && this.openPair(this.pairs[points[0].customdata]),
    };
  }
}
