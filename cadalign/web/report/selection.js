// Filters and order of the gallery.

/** Value of the method filter for all shown methods, of which the worst counts. */
export const EVERY = "*";

/** Names of the gallery's filters in the state. */
export const FILTERS = ["category", "method", "status", "q", "run"];

/** Read the gallery's choices from the state. */
export function criteria(report, state) {
  const hidden = state.words("hide");
  const shown = report.fitted.filter((method) => !hidden.has(method.key));
  const metric = report.metric.get(state.get("sort")) ?? report.metrics[0];
  const wanted = state.get("method");
  const chosen = wanted === EVERY ? null : (report.method.get(wanted) ?? shown[0]);
  return { metric, shown, methods: chosen ? [chosen] : shown, chosen };
}

/** Larger is worse: infinity for failures, NaN without a value. */
function badness(report, instance, { metric, methods }) {
  let worst = NaN;
  for (const { key } of methods) {
    if (!instance.rows.has(key)) continue;
    const value = metric ? report.error(instance, key, metric.key) : null;
    const failed = report.failed(instance, key);
    // A good fit may have no value: a model without volume has no box IoU.
    if (value === null && !failed) continue;
    const bad = failed ? Infinity : metric.better === "high" ? -value : value;
    if (!(worst >= bad)) worst = bad;
  }
  return worst;
}

/** The instances that pass the gallery's filters, in its order. */
export function select(report, state) {
  const chosen = criteria(report, state);
  const text = state.get("q").trim().toLowerCase();
  const run = state.number("run");
  const hiddenRuns = state.words("hideruns");
  const [category, status] = [state.get("category"), state.get("status")];

  const passes = (instance) => {
    if (run === null ? hiddenRuns.has(String(instance.run)) : instance.run !== run) return false;
    if (category && instance.category !== category) return false;
    if (text && !instance.model.toLowerCase().includes(text)) return false;
    const tried = chosen.methods.filter(({ key }) => instance.rows.has(key));
    if (chosen.methods.length && !tried.length) return false;
    const failed = tried.some(({ key }) => report.failed(instance, key));
    return !status || failed === (status === "failed");
  };

  const list = report.instances.filter(passes);
  if (state.get("order") === "listed") return list;
  const bad = new Map(list.map((instance) => [instance, badness(report, instance, chosen)]));
  const sign = state.get("order") === "best" ? 1 : -1;
  return list.sort((a, b) => {
    const [x, y] = [bad.get(a), bad.get(b)];
    if (x === y || (Number.isNaN(x) && Number.isNaN(y))) return a.index - b.index;
    if (Number.isNaN(x)) return 1;
    if (Number.isNaN(y)) return -1;
    return sign * (x < y ? -1 : 1);
  });
}
