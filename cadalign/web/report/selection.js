// Which instances the gallery shows, and in which order.
import { randomStream } from "./statistics.js";
import { keyOf } from "./payload.js";

/** The method's name that stands for all that are shown: the worst of them counts. */
export const EVERY = "*";

/** What the gallery's filters are called in the state. */
export const FILTERS = ["category", "method", "status", "kmin", "kmax", "emin", "emax", "q", "run"];

/** The choices of the gallery, read off the state; absent ones mean what reads best. */
export function criteria(report, state) {
  const hidden = state.words("hide");
  const shown = report.fitted.filter((method) => !hidden.has(method.key));
  const metric = report.metric.get(state.get("sort")) ?? report.metrics[0];
  const wanted = state.get("method");
  const usual = shown.includes(report.best) ? report.best : shown[0];
  const chosen = wanted === EVERY ? null : (report.method.get(wanted) ?? usual);
  return { metric, shown, methods: chosen ? [chosen] : shown, chosen };
}

/** The larger the worse; failures are worst, and what has no value is not a number. */
function badness(report, instance, { metric, methods }) {
  let worst = NaN;
  for (const { key } of methods) {
    if (!instance.rows.has(key)) continue;
    const value = metric ? report.error(instance, key, metric.key) : null;
    const failed = report.failed(instance, key);
    // A good fit may have no value, as the box IoU of a model without volume.
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
  const within = range(state.number("kmin"), state.number("kmax"));
  const errorWithin = range(state.number("emin"), state.number("emax"));
  const limited = state.number("emin") !== null || state.number("emax") !== null;

  const passes = (instance) => {
    if (run === null ? hiddenRuns.has(String(instance.run)) : instance.run !== run) return false;
    if (category && instance.category !== category) return false;
    if (text && !instance.model.toLowerCase().includes(text)) return false;
    if (!within(instance.keypoints)) return false;
    const tried = chosen.methods.filter(({ key }) => instance.rows.has(key));
    if (chosen.methods.length && !tried.length) return false;
    const failed = tried.some(({ key }) => report.failed(instance, key));
    if (status && failed !== (status === "failed")) return false;
    if (!limited) return true;
    return tried.some(({ key }) => {
      const error = report.error(instance, key, chosen.metric.key);
      return error !== null && errorWithin(error);
    });
  };

  const list = report.instances.filter(passes);
  return arrange(report, list, state, chosen);
}

function arrange(report, list, state, chosen) {
  const order = state.get("order");
  if (order === "listed") return list;
  if (order === "random") {
    const random = randomStream(state.number("seed") ?? 1);
    // The draws are those of all instances, so that a filter does not shuffle what stays.
    const draws = report.instances.map(random);
    return list.sort((a, b) => draws[a.index] - draws[b.index]);
  }
  const bad = new Map(list.map((instance) => [instance, badness(report, instance, chosen)]));
  const sign = order === "best" ? 1 : -1;
  return list.sort((a, b) => {
    const [x, y] = [bad.get(a), bad.get(b)];
    if (x === y || (Number.isNaN(x) && Number.isNaN(y))) return a.index - b.index;
    if (Number.isNaN(x)) return 1;
    if (Number.isNaN(y)) return -1;
    return sign * (x < y ? -1 : 1);
  });
}

function range(low, high) {
  if (low === null && high === null) return () => true;
  return (value) => value !== null && value >= (low ?? -Infinity) && value <= (high ?? Infinity);
}

/**
 * The instances that two runs share, those that changed most first.
 *
 * @returns {{key: string, a: object, b: object, before: number|null, after: number|null,
 *   change: number}[]} change: by how much b is worse; infinite where only one of them failed
 */
export function pairs(report, { a, b, method, metric }) {
  const found = [];
  for (const instance of report.instances) {
    if (instance.run !== a || !instance.rows.has(method)) continue;
    const other = report.sibling(instance, b);
    if (!other?.rows.has(method)) continue;
    const before = report.error(instance, method, metric.key);
    const after = report.error(other, method, metric.key);
    const change = changeOf(report, { a: instance, b: other, method, metric, before, after });
    found.push({ key: keyOf(instance), a: instance, b: other, before, after, change });
  }
  return found.sort((x, y) => Math.abs(y.change) - Math.abs(x.change) || x.a.index - y.a.index);
}

function changeOf(report, { a, b, method, metric, before, after }) {
  if (before !== null && after !== null)
    return metric.better === "high" ? before - after : after - before;
  return (report.failed(b, method) ? Infinity : 0) - (report.failed(a, method) ? Infinity : 0) || 0;
}
