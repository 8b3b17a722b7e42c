// The plots' contents, made from the tables: no charts library here, so that each can be tested alone.
import { named } from "./format.js";
import { binned, cumulative, quantile } from "./statistics.js";

/** The lines of one plot: `{run, method, x, y, low?, high?, counts?}` in the units of the axes. */

/** Who has numbers: every method in every run, or in all runs together. */
function groups(report, { pooled = false } = {}) {
  const runs = pooled ? [null] : report.runs.map((_, index) => index);
  return runs.flatMap((run) =>
    report.measured.map((method) => ({
      run,
      method: method.key,
      instances: report.instances.filter(
        (instance) => (run === null || instance.run === run) && instance.rows.has(method.key),
      ),
    })),
  );
}

/** Where a metric's cumulative curve ends: as told, or where nearly all values are. */
function endOf(report, metric) {
  if (metric.limit) return metric.limit;
  const values = report.rows.values.get(metric.key).filter((value) => value !== null);
  values.sort((a, b) => a - b);
  return quantile(values, 0.98) || 1;
}

function cumulativePlot(report) {
  const values = (group, metric) =>
    group.instances
      .map((instance) => report.error(instance, group.method, metric.key))
      .filter((v) => v !== null);
  return {
    id: "cumulative",
    title: (metric) => `Share of instances by ${metric.label}`,
    note: "Failed fits count as never reached.",
    axes: (metric) => ({
      x: {
        label: `${named(metric)}, ${metric.better === "high" ? "at least" : "at most"}`,
        rangemode: "tozero",
      },
      y: { label: "instances [%]", range: [0, 102] },
    }),
    lines: (metric) => {
      const limit = endOf(report, metric);
      return groups(report)
        .filter((group) => group.instances.length && report.rows.values.get(metric.key)?.length)
        .map((group) => ({
          ...group,
          ...cumulative(values(group, metric), group.instances.length, {
            limit,
            high: metric.better === "high",
          }),
        }));
    },
  };
}

function againstPlot(report, { id, words, unit, value, pooled }) {
  const label = named({ label: words, unit });
  return {
    id,
    title: (metric) => `${capital(metric.label)} against ${words}`,
    note: "Medians of the fits that succeeded; the band holds the middle half.",
    axes: (metric) => ({ x: { label }, y: { label: named(metric), log: metric.log } }),
    lines: (metric) =>
      groups(report, { pooled }).flatMap((group) => {
        const points = group.instances
          .map((instance) => [value(instance), report.error(instance, group.method, metric.key)])
          .filter(([x, y]) => x !== null && y !== null);
        if (!points.length) return [];
        const bins = binned(
          points.map(([x]) => x),
          points.map(([, y]) => y),
        );
        const of = (name) => bins.map((bin) => bin[name]);
        const [x, y, low, high, counts] = ["x", "middle", "low", "high", "n"].map(of);
        return [{ ...group, x, y, low, high, counts }];
      }),
  };
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

const AGAINST = [
  { id: "keypoints", words: "visible keypoints", value: (i) => i.keypoints },
  { id: "noise", words: "noise", unit: "px", value: (i) => i.noise, pooled: true },
  { id: "stretch-y", words: "true stretch along y", value: (i) => i.trueY },
  { id: "stretch-z", words: "true stretch along z", value: (i) => i.trueZ },
];

/** A plot that the payload brings as lines (sweeps of a simulation). */
function givenPlot({ id, title, x, y, traces, note }) {
  return {
    id,
    title: () => title,
    note,
    fixed: true,
    axes: () => ({ x: { ...x, label: named(x) }, y: { ...y, label: named(y) } }),
    lines: () => traces,
  };
}

/** The plots that this report has something for. */
export function plotsOf(report) {
  const plots = report.linePlots.map(givenPlot);
  if (!report.metrics.length || !report.rows.count) return plots;
  plots.push(cumulativePlot(report));
  for (const against of AGAINST) {
    const values = new Set(report.instances.map(against.value).filter((value) => value !== null));
    if (values.size > 1) plots.push(againstPlot(report, against));
  }
  return plots;
}
