// The section of plots: each is drawn when it comes into view, and again after changes.
import { isPrinting, onThemeChange, themeColor } from "../common/colors.js";
import { h } from "../common/dom.js";
import { named } from "./format.js";
import { DASHES, SYMBOLS, colorOf, placeOf, runDash } from "./swatch.js";

const PAPER = 330; // width of a plot on paper [CSS px]: two beside each other on A4 and letter
const MARKERS = 16; // on a line at most
// On touch screens, a plot scrolls the page.
const COARSE = matchMedia("(pointer: coarse)").matches;
const CONFIG = {
  displaylogo: false,
  responsive: true,
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
};

export function plotSection(report, state) {
  if (!report.plots.length) return null;
  return h(
    "section",
    { id: "plots", "aria-labelledby": "plots-title" },
    h("h2", { id: "plots-title" }, "Plots"),
    h(
      "div",
      { class: "plots" },
      report.plots.map((plot) => figure(report, state, plot)),
    ),
  );
}

function figure(report, state, plot) {
  const host = h("div", {
    class: "plot",
    id: `plot-${plot.id}`,
    role: "img",
    "aria-label": plot.title,
  });
  let seen = false;
  const show = async () => {
    seen = true;
    const { default: library } = await import("plotly.js-basic-dist-min");
    const [methods, runs] = [state.words("hide"), state.words("hideruns")];
    const lines = plot.traces.filter(
      ({ method, run }) => !methods.has(method) && !runs.has(String(run)),
    );
    const layout = layoutOf(plot, lines);
    // The browser makes the layout for printing after this event.
    if (isPrinting()) Object.assign(layout, { width: PAPER, height: 0.72 * PAPER });
    await library.react(host, tracesOf(report, lines), layout, CONFIG);
    host.dataset.drawn = "1";
  };
  const refresh = () => seen && show();
  const inView = (entries) => !seen && entries.some((entry) => entry.isIntersecting) && show();
  new IntersectionObserver(inView, { rootMargin: "300px" }).observe(host);
  state.listen((names) => (names.has("hide") || names.has("hideruns")) && refresh());
  onThemeChange(refresh);
  addEventListener("beforeprint", show);
  return h(
    "figure",
    { class: "panel" },
    h("h3", {}, plot.title),
    host,
    plot.note && h("figcaption", {}, plot.note),
  );
}

/** Escape a name: Plotly interprets some tags and `%{...}`. */
const plain = (text) =>
  String(text)
    .replaceAll("&", "&amp;")
    .replaceAll("<", "&lt;")
    .replaceAll(">", "&gt;")
    .replaceAll("%{", "%\u200b{");

/** Traces of lines. */
function tracesOf(report, lines) {
  const several = report.runs.length > 1;
  return lines.map(({ run, method: key, x, y }) => {
    const method = report.method.get(key);
    const color = colorOf(method);
    return {
      x,
      y,
      name: plain(several ? `${key}, ${report.runs[run].name}` : key),
      mode: "lines+markers",
      line: { color, width: 2.5, dash: several ? runDash(run) : (method?.dash ?? "solid") },
      marker: { color, size: 6, symbol: SYMBOLS[placeOf(report, key)][0], maxdisplayed: MARKERS },
      hovertemplate: "%{y:.3~g}",
    };
  });
}

/** Number of decades that positive values span. */
function decades(values) {
  const positive = values.filter((value) => value > 0).map(Math.log10);
  const bound = (pick, start) => positive.reduce((a, b) => pick(a, b), start);
  return positive.length ? bound(Math.max, -Infinity) - bound(Math.min, Infinity) : 0;
}

/** Layout of a plot; the page has the title and the legend. */
function layoutOf({ x, y }, lines) {
  const [ink, soft, line, card] = ["ink", "soft", "line", "card"].map(themeColor);
  const values = (name) => lines.flatMap((one) => one[name] ?? []);
  const axis = (metric, all) => ({
    title: { text: plain(named(metric)), standoff: 8, font: { size: 13 } },
    type: metric.log ? "log" : "linear",
    ...(metric.log ? { tickformat: "~g", dtick: decades(all) > 3 ? 1 : "D2" } : {}),
    gridcolor: line,
    zerolinecolor: line,
    linecolor: line,
    tickfont: { size: 12, color: soft },
    automargin: true,
  });
  return {
    font: { family: getComputedStyle(document.body).fontFamily, color: ink, size: 13 },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    margin: { l: 52, r: 12, t: 10, b: 44 },
    xaxis: axis(x, values("x")),
    yaxis: axis(y, values("y")),
    showlegend: false,
    hovermode: "x unified",
    hoverlabel: { bgcolor: card, bordercolor: line, font: { color: ink, size: 12 } },
    dragmode: COARSE ? false : "zoom",
  };
}
