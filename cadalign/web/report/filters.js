// The switches that all parts of the page obey (methods, runs) and the gallery's form.
import { button, debounced, field, h } from "../common/dom.js";
import { named, plural } from "./format.js";
import { EVERY, FILTERS } from "./selection.js";
import { runSwatch, swatch } from "./swatch.js";

/** Buttons that take methods and runs in and out everywhere. */
export function switches(report, state) {
  const buttons = [];
  const add = (list, word, ...words) => {
    const chip = button(words, () => state.toggle(list, word), { class: "chip" });
    buttons.push({ chip, list, word });
    return chip;
  };
  const update = () => {
    for (const { chip, list, word } of buttons) {
      chip.setAttribute("aria-pressed", String(!state.words(list).has(word)));
    }
  };
  state.listen(update);
  const element = h(
    "div",
    { class: "switches" },
    h(
      "div",
      { role: "group", "aria-label": "methods shown", class: "chips" },
      report.methods.map((method) => add("hide", method.key, swatch(report, method), method.label)),
    ),
    report.runs.length > 1 &&
      h(
        "div",
        { role: "group", "aria-label": "runs shown", class: "chips" },
        report.runs.map((run, index) => add("hideruns", String(index), runSwatch(index), run.name)),
      ),
  );
  update();
  return element;
}

/** A field bound to a value of the state. */
function bound(state, name, control, { event = "change", wait = 0, also = {} } = {}) {
  const write = () => state.set({ [name]: control.value, ...also });
  control.addEventListener(event, wait ? debounced(write, wait) : write);
  const read = () => {
    if (document.activeElement !== control || control.tagName === "SELECT")
      control.value = state.get(name);
  };
  state.listen((names) => names.has(name) && read());
  read();
  return control;
}

export function select(state, name, options, { fallback } = {}) {
  const control = h(
    "select",
    {},
    options.map(([value, label]) => h("option", { value }, label)),
  );
  bound(state, name, control);
  const known = () => options.some(([value]) => value === state.get(name));
  const settle = () => {
    if (!known()) control.value = fallback ?? options[0]?.[0] ?? "";
  };
  state.listen(settle);
  settle();
  return control;
}

/** Values and names of what fields choose among. */
export const metricOptions = ({ metrics }) => metrics.map((metric) => [metric.key, named(metric)]);
export const methodOptions = ({ fitted }) => fitted.map(({ key, label }) => [key, label]);
export const runOptions = ({ runs }) => runs.map(({ name }, index) => [String(index), name]);

function numbers(state, title, low, high) {
  const box = (name, words) =>
    bound(
      state,
      name,
      h("input", {
        type: "number",
        step: "any",
        min: 0,
        placeholder: words,
        "aria-label": `${title}, ${words}`,
      }),
      { event: "input", wait: 200 },
    );
  return h(
    "fieldset",
    { class: "field range" },
    h("legend", {}, title),
    box(low, "from"),
    h("span", { "aria-hidden": "true" }, "\u2013"),
    box(high, "to"),
  );
}

/** The gallery's form: sorting, filters, search, and the three picks. */
export function galleryForm(report, state) {
  const metrics = metricOptions(report);
  const seed = () => String(1 + Math.floor(Math.random() * 1e6));
  const pick = (order, words) =>
    button(words, () => state.set(order === "random" ? { order, seed: seed() } : { order }), {
      class: "pick",
      "data-order": order,
    });
  const picks = [pick("worst", "Worst"), pick("best", "Best"), pick("random", "Random")];
  const mark = () => {
    for (const one of picks)
      one.setAttribute("aria-pressed", String(one.dataset.order === state.get("order")));
  };
  state.listen(mark);
  mark();
  const error = h("div", { class: "slot" });
  const retitle = () => {
    const metric = report.metric.get(state.get("sort")) ?? report.metrics[0];
    if (metric && error.dataset.metric !== metric.key) {
      error.dataset.metric = metric.key;
      error.replaceChildren(numbers(state, named(metric), "emin", "emax"));
    }
  };
  state.listen(retitle);
  retitle();
  const clear = () => state.set(Object.fromEntries(FILTERS.map((name) => [name, ""])));
  return h(
    "form",
    {
      class: "filters",
      role: "search",
      "aria-label": "filter the gallery",
      onsubmit: (event) => event.preventDefault(),
    },
    h("div", { class: "picks", role: "group", "aria-label": "order" }, picks),
    metrics.length > 0 && field("by", select(state, "sort", metrics)),
    field(
      "of",
      select(state, "method", [...methodOptions(report), [EVERY, "all methods shown"]], {
        fallback: report.best?.key,
      }),
    ),
    report.categories.length > 1 &&
      field(
        "category",
        select(state, "category", [["", "all"], ...report.categories.map((name) => [name, name])]),
      ),
    report.runs.length > 1 &&
      field("run", select(state, "run", [["", "all"], ...runOptions(report)])),
    field(
      "status",
      select(state, "status", [
        ["", "all"],
        ["ok", "succeeded"],
        ["failed", "failed"],
      ]),
    ),
    numbers(state, "keypoints", "kmin", "kmax"),
    metrics.length > 0 && error,
    field(
      "model id",
      bound(
        state,
        "q",
        h("input", { type: "search", placeholder: "search", autocomplete: "off", spellcheck: "false" }),
        { event: "input", wait: 150 },
      ),
    ),
    button("Clear filters", clear, { class: "quiet" }),
  );
}

export const foundWords = (found, all) =>
  found === all
    ? plural(all, "instance")
    : `${plural(found, "instance")} of ${all.toLocaleString("en-US")}`;
