// The payload as the page speaks of it: instances with their rows, and what is fetched on demand.
// Its format is described in cadalign/report/page.py.

import { median } from "./statistics.js";

/** The payload that the page carries; its text is let go, as pictures make it large. */
export function readPayload() {
  const element = document.getElementById("payload");
  const payload = JSON.parse(element.textContent);
  element.remove();
  return payload;
}

/** What names an instance within a run, in links too. */
export const keyOf = (instance) => `${instance.category}/${instance.model}/${instance.view ?? 0}`;

export class Report {
  constructor(payload) {
    const { title, summary, runs, methods, metrics, headline } = payload;
    Object.assign(this, { title, summary, runs, methods, metrics, headline });
    this.linePlots = payload.plots;
    const fileOf = (id) => payload.exhibit_files?.[Math.floor(id / payload.exhibits_per_file)];
    this.exhibits = new Fetched(payload.exhibits, "cadalignExhibit", fileOf);
    this.meshes = new Fetched(payload.meshes, "cadalignMesh", (key) => payload.mesh_files?.[key]);
    this.pictures = payload.pictures ?? {};
    this.thumbs = payload.thumbs ?? {};
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
    // A limit has numbers, but no poses: it stands in tables and plots only.
    this.measured = this.methods.filter((_, index) => used.has(index));
    this.fitted = this.measured.filter((method) => !method.is_limit);
    this.best = this.bestMethod();
  }

  readRows({ strings, rows: table }) {
    const count = table.method.length;
    for (let row = 0; row < count; row++) {
      this.instances[table.instance[row]].rows.set(this.methods[table.method[row]].key, row);
    }
    const values = new Map(
      this.metrics.map(({ key, factor = 1 }) => [
        key,
        (table[key] ?? []).map((value) => (value == null ? null : value * factor)),
      ]),
    );
    const reason = (row) => strings[table.reason[row]] ?? "";
    return { count, method: table.method, status: table.status, reason, values };
  }

  /** The method of the smallest median error: what the gallery begins with. */
  bestMethod() {
    const metric = this.metrics[0];
    const sign = metric?.better === "high" ? -1 : 1;
    const middles = this.fitted.map((method) => {
      const errors = this.instances.map(
        (instance) => metric && this.error(instance, method.key, metric.key),
      );
      const known = errors.filter((value) => value != null);
      return known.length ? sign * median(known) : Infinity;
    });
    return this.fitted[middles.indexOf(Math.min(...middles))];
  }

  /** A metric of an instance by one method in the metric's unit; null where there is none. */
  error(instance, method, metric) {
    const row = instance.rows.get(method);
    return row === undefined ? null : (this.rows.values.get(metric)?.[row] ?? null);
  }

  /** Whether a method was tried on an instance and gave nothing. */
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

  /** The same instance in another run, if it is there. */
  sibling(instance, run) {
    return this.siblings.get(instance.id)?.find((other) => other.run === run);
  }

  exhibit(instance) {
    return instance.exhibit < 0 ? Promise.resolve(null) : this.exhibits.get(instance.exhibit);
  }

  picture(exhibit) {
    return this.pictures[exhibit?.picture] ?? null;
  }

  thumb(instance) {
    return this.thumbs[instance.thumb] ?? null;
  }
}

/** Things by key that the page has, or that a script beside it brings: a file may not fetch. */
class Fetched {
  #scripts = new Map();

  constructor(things, callback, source) {
    this.things = new Map(Object.entries(things ?? {}));
    this.source = source;
    window[callback] = (key, thing) => this.things.set(String(key), thing);
  }

  /** The thing if it is here already, else null. */
  now(key) {
    return this.things.get(String(key)) ?? null;
  }

  /** A promise of the thing; null where it is missing. */
  async get(key) {
    if (key == null) return null;
    const file = this.things.has(String(key)) ? null : this.source(key);
    if (file) {
      if (!this.#scripts.has(file)) this.#scripts.set(file, loadScript(file));
      await this.#scripts.get(file);
    }
    return this.now(key);
  }
}

/** Run a script; a missing one is no more than its things missing. */
function loadScript(source) {
  return new Promise((resolve) => {
    const script = document.createElement("script");
    const done = () => {
      script.remove();
      resolve();
    };
    script.addEventListener("load", done);
    script.addEventListener("error", done);
    script.src = source;
    document.head.append(script);
  });
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
    trueY: table.true_y[index],
    trueZ: table.true_z[index],
    noise: table.noise[index],
    exhibit: table.exhibit[index],
    thumb: table.thumb[index],
    rows: new Map(),
  }));
}
