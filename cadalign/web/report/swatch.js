// Colours, lines and symbols of methods in all legends.
import { svg } from "../common/dom.js";
import { isDark } from "../common/colors.js";

const DASHES = { solid: "", dash: "6 4", dot: "2 3", dashdot: "7 3 2 3" };

/** Plotly's names of symbols, and their SVG paths, centred in a swatch. */
export const SYMBOLS = [
  ["circle", "M9 5a4 4 0 1 0 8 0a4 4 0 1 0-8 0Z"],
  ["square", "M9.5 1.5h7v7h-7Z"],
  ["diamond", "M13 0L18 5L13 10L8 5Z"],
  ["triangle-up", "M13 0.5L17.8 9H8.2Z"],
  ["triangle-down", "M13 9.5L17.8 1H8.2Z"],
  ["cross", "M11.5 0.5h3v3h3v3h-3v3h-3v-3h-3v-3h3Z"],
  ["star", "M13 0l1.3 3.4 3.7.2-2.9 2.3 1 3.6-3.1-2-3.1 2 1-3.6L8 3.6l3.7-.2Z"],
];

/** Dash patterns of the runs. */
export const runDash = (run) => Object.keys(DASHES)[run % 4];

/** Index of a method's symbol. */
export const placeOf = (report, key) =>
  Math.max(
    report.methods.findIndex((method) => method.key === key),
    0,
  ) % SYMBOLS.length;

/** Colour of a method in the current theme. */
export const colorOf = (method, dark = isDark()) =>
  (dark ? method?.color_dark : method?.color) ?? "#808080";

function lineMark(dash, style, symbol) {
  const line = { d: "M1 5H25", stroke: "currentColor", "stroke-width": 2.5 };
  return svg(
    "svg",
    { class: "swatch", viewBox: "0 0 26 10", width: 26, height: 10, "aria-hidden": "true", style },
    svg("path", { ...line, "stroke-dasharray": DASHES[dash] ?? "" }),
    symbol && svg("path", { d: symbol, fill: "currentColor" }),
  );
}

/** A short piece of a run's line. */
export const runSwatch = (run) => lineMark(runDash(run));

/** A short piece of a method's line. Both colours are given, so that CSS picks with the theme. */
export function swatch(report, method) {
  if (!method) return null;
  const color = `color: light-dark(${colorOf(method, false)}, ${colorOf(method, true)})`;
  return lineMark(method.dash, color, SYMBOLS[placeOf(report, method.key)][1]);
}
