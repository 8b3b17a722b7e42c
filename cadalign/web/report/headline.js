// The headline table, reasons of failures, and settings of the runs.
import { h, table } from "../common/dom.js";
import { count, number, plural } from "./format.js";
import { swatch } from "./swatch.js";

/** The top of the page: title, summary, progress and settings. */
export function heading(report) {
  return h(
    "header",
    { class: "hero" },
    h("p", { class: "kicker" }, "cadalign"),
    h("h1", {}, report.title),
    h("p", { class: "lead" }, report.summary),
    report.runs.map((run) => runFacts(run, report.runs.length)),
  );
}

function runFacts(run, runs) {
  const { done, total } = run;
  const bar = { value: done, max: total, "aria-label": `progress of ${run.name}` };
  const progress = run.state !== "finished" && [
    h("strong", {}, total ? "Unfinished: " : "Unfinished. "),
    total > 0 && `${count(done)} of ${count(total)} instances are done. `,
    "Numbers may still change. ",
    total > 0 && h("progress", bar),
  ];
  const facts = run.settings.map(([name, value]) =>
    h("div", {}, h("dt", {}, name), h("dd", {}, String(value))),
  );
  const words = runs > 1 ? run.name : "Settings";
  return [
    progress && h("p", { class: "warning" }, progress),
    facts.length > 0 &&
      h("details", { class: "facts" }, h("summary", {}, words), h("dl", {}, facts)),
  ];
}

/** The section with the headline table. */
export function headline(report) {
  const { headline: given } = report;
  if (!given.rows.length) {
    return h(
      "section",
      { id: "results" },
      h("h2", {}, "Results"),
      h("p", { class: "empty" }, "No results yet."),
    );
  }
  return h(
    "section",
    { id: "results", "aria-labelledby": "results-title" },
    h("h2", { id: "results-title" }, "Results"),
    h(
      "div",
      { class: "scroller", tabindex: 0, role: "region", "aria-labelledby": "results-title" },
      resultTable(report, given),
    ),
    h("p", { class: "note" }, given.rows.some(({ best }) => best.length) && legend(given), given.note),
    reasons(report, given.failures, "failed"),
    reasons(report, given.skipped, "skipped"),
  );
}

/** The meaning of the marked cells. */
const legend = ({ group }) => [
  h("b", { class: "best" }, "Bold on a tinted field"),
  ` is the best of its ${group}. `,
];

function resultTable(report, { columns, rows, group }) {
  const several = report.runs.length > 1;
  // The group of all categories comes first.
  const first = (name) => (name === "all" ? 0 : 1);
  const names = [...new Set(rows.map((row) => row.category))].sort(
    (a, b) => first(a) - first(b),
  );
  const bodies = names.map((name) =>
    h(
      "tbody",
      {},
      name !== "" &&
        h(
          "tr",
          { class: "group" },
          h(
            "th",
            { scope: "rowgroup", colspan: columns.length + 1 + several },
            h("span", {}, groupWords(group, name)),
          ),
        ),
      inOrder(
        report,
        rows.filter((row) => row.category === name),
      ).map((row) => bodyRow(report, columns, row, several)),
    ),
  );
  return h(
    "table",
    { class: "headline" },
    h("caption", { class: "visually-hidden" }, `Results by ${group} and method`),
    h(
      "thead",
      {},
      h(
        "tr",
        {},
        h("th", { scope: "col" }, "method"),
        several && h("th", { scope: "col", class: "words" }, "run"),
        columns.map((column) =>
          h(
            "th",
            { scope: "col" },
            column.label,
            column.unit && h("small", {}, ` [${column.unit}]`),
          ),
        ),
      ),
    ),
    bodies,
  );
}

// The name of a category is clear; a value, such as a noise level, needs the group's name.
const groupWords = (group, name) => (group === "category" ? name : `${group}: ${name}`);

/** Sort rows by method, then by run. */
function inOrder(report, rows) {
  const place = new Map(report.methods.map((method, index) => [method.key, index]));
  return rows.toSorted((a, b) => place.get(a.method) - place.get(b.method) || a.run - b.run);
}

function bodyRow(report, columns, row, several) {
  const method = report.method.get(row.method);
  return h(
    "tr",
    {},
    h("th", { scope: "row" }, swatch(report, method), row.method),
    several && h("td", { class: "words" }, report.runs[row.run]?.name),
    columns.map((column) => {
      const text = shown(column, row.cells[column.key]);
      const best = row.best.includes(column.key);
      return h(
        "td",
        {},
        best
          ? h("b", { class: "best" }, text, h("span", { class: "visually-hidden" }, " (best)"))
          : text,
      );
    }),
  );
}

const shown = ({ digits }, value) =>
  number(value, Number.isInteger(value) && !digits ? undefined : digits);

/** Table of the reasons of failed or skipped fits, with counts. */
function reasons(report, list, what) {
  if (!list.length) return null;
  const total = list.reduce((sum, failure) => sum + failure.count, 0);
  const several = report.runs.length > 1;
  const rows = list
    .toSorted((a, b) => b.count - a.count)
    .map((failure) =>
      h(
        "tr",
        {},
        h("td", { class: "words" }, failure.reason),
        h("td", {}, count(failure.count)),
        h("td", { class: "words" }, failure.method),
        h("td", { class: "words" }, failure.category),
        several && h("td", { class: "words" }, report.runs[failure.run]?.name),
      ),
    );
  const heads = [
    ["reason", "words"], "fits", ["method", "words"], [report.headline.group, "words"], several && ["run", "words"],
  ];
  return h(
    "details",
    { class: "failures" },
    h("summary", {}, `${plural(total, "fit")} ${what}, by reason`),
    table(`Fits ${what}, by reason`, heads, rows, { label: `${what}, by reason`, hidden: true }),
  );
}
