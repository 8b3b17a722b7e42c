// The payload as instances with their rows.
// Its format is described in cadalign/report/page.py.

/** Parse the page's payload and remove its text, which may be large. */
export function readPayload() {
  const element = document.getElementById("payload");
  const payload = JSON.parse(element.textContent);
  element.remove();
  return payload;
}

/** Key of an instance within a run, also in links. */
export const keyOf = (instance) => `${instance.category}/${instance.model}/${instance.view ?? 0}`;

export class Report {
  constructor(payload) {
    const { title, summary, runs, methods, metrics, headline, plots } = payload;
    Object.assign(this, { title, summary, runs, methods, metrics, headline, plots });
    const { exhibits = {}, meshes = {}, pictures = {}, thumbs = {} } = payload;
    Object.assign(this, { exhibits, meshes, pictures, thumbs });
    this.method = new Map(this.methods.map((method) => [method.key, method]));
    this.metric = new Map(this.metrics.map((metric) => [metric.key, metric]));
    const tables = payload.tables ?? { strings: [], instances: { id: [] }, rows: { method: [] } };
    this.instances = readInstances(tables);
    this.rows = this.readRows(tables);
    this.categories = [...new Set(this.instances.map((instance) => instance.category))].sort();
    this.byKey = new Map(
      this.instances.map((instance) => [`${instance.run} ${keyOf(instance)}`, instance]),
    );
    this.siblings = Map.groupBy(this.instances, ({ id }) => id);
    const used = new Set(this.rows.method);
    // A limit has no poses: it is only in tables and plots.
    this.measured = this.methods.filter((_, index) => used.has(index));
    this.fitted = this.measured.filter((method) => !method.is_limit);
  }

  readRows({ strings, rows: table }) {
    table.method.forEach((method, row) =>
      this.instances[table.instance[row]].rows.set(this.methods[method].key, row),
    );
    const values = new Map(
      this.metrics.map(({ key, factor = 1 }) => [
        key,
        (table[key] ?? []).map((value) => (value == null ? null : value * factor)),
      ]),
    );
    const reason = (row) => strings[table.reason[row]] ?? "";
    return { method: table.method, status: table.status, reason, values };
  }

  /** A method's value of a metric on an instance, in the metric's unit, or null. */
  error(instance, method, metric) {
    const row = instance.rows.get(method);
    return row === undefined ? null : (this.rows.values.get(metric)?.[row] ?? null);
  }

  /** Whether a method failed on an instance. */
  failed(instance, method) {
    const row = instance.rows.get(method);
    return row !== undefined && this.rows.status[row] !== 0;
  }

  reason(instance, method) {
    const row = instance.rows.get(method);
    return row === undefined ? "" : this.rows.reason(row);
  }

  find(run, key) {
    return this.byKey.get(`${run} ${key}`);
  }

  exhibit(instance) {
    return this.exhibits[instance.exhibit] ?? null;
  }

  picture(exhibit) {
    return this.pictures[exhibit?.picture] ?? null;
  }

  thumb(instance) {
    return this.thumbs[instance.thumb] ?? null;
  }
}

function readInstances({ strings, instances: table }) {
  return table.id.map((id, index) => ({
    index,
    id,
    run: table.run[index],
    category: strings[table.category[index]],
    model: strings[table.model[index]],
    view: table.view[index],
    keypoints: table.keypoints[index],
    exhibit: table.exhibit[index],
    thumb: table.thumb[index],
    rows: new Map(),
  }));
}
