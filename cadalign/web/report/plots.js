// The section of plots: each is drawn when it comes into view, and again when what it shows changes.
import { isPrinting, onThemeChange } from "../common/colors.js";
import { field, h, table } from "../common/dom.js";
import { CONFIG, layoutOf, plotly, tracesOf } from "./chart.js";
import { plotsOf } from "./curves.js";
import { metricOptions, select } from "./filters.js";
import { count, number } from "./format.js";

const PAPER = 330; // width of a plot on paper [CSS px]: two beside each other on A4 and letter
const ROWS = 12; // lines of a plot's table at most

const whenIdle = window.requestIdleCallback ?? ((action) => setTimeout(action, 50));

/** A chart that draws itself once it is seen. */
export class Panel {
  constructor(host, draw, { square = false } = {}) {
    this.host = host;
    this.square = square;
    this.draw = draw;
    this.seen = false;
    new IntersectionObserver(
      (entries) => {
        if (this.seen || !entries.some((entry) => entry.isIntersecting)) return;
        this.seen = true;
        // One at a time, so that scrolling past many does not halt.
        whenIdle(() => this.show());
      },
      { rootMargin: "300px" },
    ).observe(host);
    onThemeChange(() => this.refresh());
    addEventListener("beforeprint", () => this.show());
  }

  async show() {
    this.seen = true;
    const library = await plotly();
    const { traces, layout, click } = this.draw();
    // The page is laid out for paper only after this.
    if (isPrinting())
      Object.assign(layout, { width: PAPER, height: this.square ? PAPER : 0.72 * PAPER });
    await library.react(this.host, traces, layout, CONFIG);
    if (click && !this.clicks) {
      this.clicks = true;
      this.host.on("plotly_click", click);
    }
    this.host.dataset.drawn = String(1 + Number(this.host.dataset.drawn ?? 0));
  }

  refresh() {
    if (this.seen) this.show();
  }
}

export function plotSection(report, state) {
  const plots = plotsOf(report);
  if (!plots.length) return null;
  const metricNow = () => report.metric.get(state.get("metric")) ?? report.metrics[0];
  const choosable = plots.some((plot) => !plot.fixed) && report.metrics.length > 1;
  return h(
    "section",
    { id: "plots", "aria-labelledby": "plots-title" },
    h("h2", { id: "plots-title" }, "Plots"),
    choosable &&
      field("metric", select(state, "metric", metricOptions(report))),
    h(
      "div",
      { class: "plots" },
      plots.map((plot) => figure(report, state, plot, metricNow)),
    ),
  );
}

function figure(report, state, plot, metricNow) {
  const host = h("div", { class: "plot", id: `plot-${plot.id}`, role: "img" });
  const title = h("h3");
  const numbers = h("details", { class: "numbers" });
  let cached = null;
  const linesNow = () => {
    const metric = metricNow();
    if (!cached || cached.metric !== metric) cached = { metric, lines: plot.lines(metric) };
    const [methods, runs] = [state.words("hide"), state.words("hideruns")];
    return cached.lines.filter(
      ({ method, run }) => !methods.has(method) && !(run !== null && runs.has(String(run))),
    );
  };
  const panel = new Panel(host, () => {
    const lines = linesNow();
    const { x, y } = plot.axes(metricNow());
    const values = (name) => lines.flatMap((line) => line[name] ?? []);
    return {
      traces: tracesOf(report, lines),
      layout: layoutOf({
        x: { ...x, values: values("x") },
        y: { ...y, values: [...values("y"), ...values("low"), ...values("high")] },
      }),
    };
  });
  const retitle = () => {
    title.textContent = plot.title(metricNow());
    host.setAttribute("aria-label", `${title.textContent}. Its numbers follow as a table.`);
    numbers.open = false;
  };
  numbers.append(h("summary", {}, "Numbers"));
  numbers.addEventListener("toggle", () => {
    while (numbers.children.length > 1) numbers.lastElementChild.remove();
    if (numbers.open)
      numbers.append(numberTable(report, plot.axes(metricNow()), linesNow(), title.textContent));
  });
  state.listen((names) => {
    const isOther = names.has("metric") && !plot.fixed;
    if (isOther) retitle();
    if (isOther || names.has("hide") || names.has("hideruns")) panel.refresh();
  });
  retitle();
  return h(
    "figure",
    { class: "panel" },
    title,
    host,
    plot.note && h("figcaption", {}, plot.note),
    numbers,
  );
}

/** A plot as a table, for those who can't see it. */
function numberTable(report, { x, y }, lines, title) {
  const several = report.runs.length > 1;
  const rows = lines.flatMap((line) => {
    const each = Math.max(1, Math.ceil(line.x.length / ROWS));
    const places = line.x.map((_, index) => index).filter((index) => index % each === 0);
    return places.map((index) =>
      h(
        "tr",
        {},
        h("th", { scope: "row" }, report.method.get(line.method)?.label ?? line.method),
        several &&
          h("td", { class: "words" }, line.run === null ? "all" : report.runs[line.run].name),
        h("td", {}, number(line.x[index])),
        h("td", {}, number(line.y[index])),
        line.counts && h("td", {}, count(line.counts[index])),
      ),
    );
  });
  const counted = lines.some((line) => line.counts);
  const heads = ["method", several && "run", x.label, y.label, counted && "fits"];
  return table(title, heads, rows, { hidden: true });
}
