// Switches of methods and runs for the whole page, and the form of the gallery.
import { button, debounced, field, h } from "../common/dom.js";
import { named } from "./format.js";
import { EVERY, FILTERS } from "./selection.js";
import { runSwatch, swatch } from "./swatch.js";

/** Buttons that show and hide methods and runs on the whole page. */
export function switches(report, state) {
  const update = [];
  const chips = (label, list, things) =>
    h(
      "div",
      { role: "group", "aria-label": label, class: "chips" },
      things.map(([word, ...words]) => {
        const chip = button(words, () => state.toggle(list, word), { class: "chip" });
        update.push(() => chip.setAttribute("aria-pressed", String(!state.words(list).has(word))));
        return chip;
      }),
    );
  const methods = report.methods.map((method) => [
    method.key,
    swatch(report, method),
    method.key,
  ]);
  const runs = report.runs.map(({ name }, index) => [String(index), runSwatch(index), name]);
  const element = h(
    "div",
    { class: "switches" },
    chips("methods shown", "hide", methods),
    runs.length > 1 && chips("runs shown", "hideruns", runs),
  );
  const all = () => update.forEach((one) => one());
  state.listen(all);
  all();
  return element;
}

/** Select box of [value, label] pairs, bound to a value of the state. */
function choice(state, name, options) {
  const control = h(
    "select",
    { onchange: () => state.set({ [name]: control.value }) },
    options.map(([value, label]) => h("option", { value }, label)),
  );
  const read = () => {
    const known = options.some(([value]) => value === state.get(name));
    control.value = known ? state.get(name) : (options[0]?.[0] ?? "");
  };
  state.listen(read);
  read();
  return control;
}

function search(state) {
  const control = h("input", {
    type: "search",
    placeholder: "search",
    autocomplete: "off",
    spellcheck: "false",
    oninput: debounced(() => state.set({ q: control.value }), 150),
  });
  const read = () => {
    if (document.activeElement !== control) control.value = state.get("q");
  };
  state.listen(read);
  read();
  return control;
}

/** The gallery's form: order, filters, search. */
export function galleryForm(report, state) {
  const metrics = report.metrics.map((metric) => [metric.key, named(metric)]);
  const methods = report.fitted.map(({ key }) => [key, key]);
  const categories = report.categories.map((name) => [name, name]);
  const runs = report.runs.map(({ name }, index) => [String(index), name]);
  const all = ["", "all"];
  const clear = () => state.set(Object.fromEntries(FILTERS.map((name) => [name, ""])));
  return h(
    "form",
    {
      class: "filters",
      role: "search",
      "aria-label": "filter the gallery",
      onsubmit: (event) => event.preventDefault(),
    },
    field(
      "order",
      choice(state, "order", [["worst", "worst first"], ["best", "best first"], ["listed", "as listed"]]),
    ),
    metrics.length > 0 && field("by", choice(state, "sort", metrics)),
    field("of", choice(state, "method", [...methods, [EVERY, "all methods shown"]])),
    categories.length > 1 && field("category", choice(state, "category", [all, ...categories])),
    runs.length > 1 && field("run", choice(state, "run", [all, ...runs])),
    field("status", choice(state, "status", [all, ["ok", "succeeded"], ["failed", "failed"]])),
    field("model id", search(state)),
    button("Clear filters", clear, { class: "quiet" }),
  );
}
