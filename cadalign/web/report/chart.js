// Plotly in the page's colours.
import { themeColor } from "../common/colors.js";
import { DASHES, SYMBOLS, colorOf, placeOf, runDash } from "./swatch.js";

const MARKERS = 16; // on a line at most
// A finger that lands on a plot is to scroll the page.
const COARSE = matchMedia("(pointer: coarse)").matches;

/** Plotly, set up when the first plot comes into view. */
export async function plotly() {
  const { default: library } = await import("plotly.js-basic-dist-min");
  return library;
}

/** A name as text: Plotly reads some tags and `%{...}` in what it is given. */
export const plain = (text) =>
  String(text)
    .replaceAll("&", "&amp;")
    .replaceAll("<", "&lt;")
    .replaceAll(">", "&gt;")
    .replaceAll("%{", "%\u200b{");

const faded = (color, alpha) =>
  color.replace(
    /^#(..)(..)(..)$/,
    (_, ...hex) =>
      `rgba(${hex
        .slice(0, 3)
        .map((part) => parseInt(part, 16))
        .join(",")},${alpha})`,
  );

/** The traces of some lines: a band where there are quartiles, then the line. */
export function tracesOf(report, lines) {
  const traces = [];
  for (const { run, method: key, x, y, low, high, counts } of lines) {
    const method = report.method.get(key);
    const color = colorOf(method);
    const several = report.runs.length > 1 && run !== null;
    const name = plain(
      several ? `${method?.label ?? key}, ${report.runs[run].name}` : (method?.label ?? key),
    );
    const dash = several ? runDash(run) : method?.dash in DASHES ? method.dash : "solid";
    const shape = {
      x,
      mode: "lines",
      hoverinfo: "skip",
      line: { width: 0, color },
      showlegend: false,
    };
    if (low && high) {
      traces.push({ ...shape, y: low });
      traces.push({ ...shape, y: high, fill: "tonexty", fillcolor: faded(color, 0.12) });
    }
    traces.push({
      x,
      y,
      name,
      mode: "lines+markers",
      line: { color, width: 2.5, dash },
      marker: { color, size: 6, symbol: SYMBOLS[placeOf(report, key)][0], maxdisplayed: MARKERS },
      customdata: counts,
      hovertemplate: `%{y:.3~g}${counts ? " (%{customdata} fits)" : ""}`,
    });
  }
  return traces;
}

/** How many powers of ten positive values reach over. */
function decades(values) {
  const positive = values.filter((value) => value > 0).map(Math.log10);
  const bound = (pick, start) => positive.reduce((a, b) => pick(a, b), start);
  return positive.length ? bound(Math.max, -Infinity) - bound(Math.min, Infinity) : 0;
}

/** The layout of a plot: no title, as the page has it, and the page's own legend. */
export function layoutOf({ x, y }, extra = {}) {
  const [ink, soft, line, card] = ["ink", "soft", "line", "card"].map(themeColor);
  const axis = ({ label, log, range, values = [], ...rest }) => ({
    title: { text: plain(label), standoff: 8, font: { size: 13 } },
    type: log ? "log" : "linear",
    ...(range ? { range } : {}),
    ...(log ? { tickformat: "~g", dtick: decades(values) > 3 ? 1 : "D2" } : {}),
    gridcolor: line,
    zerolinecolor: line,
    linecolor: line,
    tickfont: { size: 12, color: soft },
    automargin: true,
    ...rest,
  });
  return {
    font: { family: getComputedStyle(document.body).fontFamily, color: ink, size: 13 },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    margin: { l: 52, r: 12, t: 10, b: 44 },
    xaxis: axis(x),
    yaxis: axis(y),
    showlegend: false,
    hovermode: "x unified",
    hoverlabel: { bgcolor: card, bordercolor: line, font: { color: ink, size: 12 } },
    dragmode: COARSE ? false : "zoom",
    ...extra,
  };
}

export const CONFIG = {
  displaylogo: false,
  responsive: true,
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
};
