// The numbers of one instance: errors of every method, the estimate with its deviations, warnings.
import { h } from "../common/dom.js";
import { named, number, quantity } from "./format.js";
import { swatch } from "./swatch.js";

const AXES = ["x", "y", "z"];

/** A table of every method's errors on an instance. */
export function errorTable(report, instance, exhibit) {
  const metrics = report.metrics.filter(({ key }) =>
    report.measured.some((method) => report.error(instance, method.key, key) !== null),
  );
  const rows = report.measured
    .filter(({ key }) => instance.rows.has(key))
    .map((method) => {
      const estimate = estimateOf(exhibit, method.key);
      const failed = report.failed(instance, method.key);
      const reason =
        report.reason(instance, method.key) || estimate?.reason || "no reason is recorded";
      return h(
        "tr",
        {},
        h("th", { scope: "row" }, swatch(report, method), method.label),
        failed
          ? h("td", { class: "words failed", colspan: metrics.length + 1 }, `failed: ${reason}`)
          : [
              metrics.map((metric) =>
                h("td", {}, number(report.error(instance, method.key, metric.key), metric.digits)),
              ),
              h("td", {}, number(estimate?.rms_px, 2)),
            ],
      );
    });
  const heads = [...metrics.map((metric) => named(metric)), "residual [px]"];
  return h(
    "div",
    { class: "scroller", tabindex: 0, role: "region", "aria-label": "errors by method" },
    h(
      "table",
      {},
      h("caption", {}, "Errors"),
      h(
        "thead",
        {},
        h(
          "tr",
          {},
          h("th", { scope: "col" }, "method"),
          heads.map((head) => h("th", { scope: "col" }, head)),
        ),
      ),
      h("tbody", {}, rows),
    ),
  );
}

/** A method's estimate in an exhibit, if there is one. */
export const estimateOf = (exhibit, method) =>
  exhibit?.estimates?.find((estimate) => estimate.method === method) ?? null;

/** The estimate of a method beside the truth, with its predicted standard deviations. */
export function estimateTable(exhibit, estimate, label) {
  const { std, translation, scale } = estimate;
  const truth = exhibit.gt;
  const row = (name, value, deviation, true_) =>
    h(
      "tr",
      {},
      h("th", { scope: "row" }, name),
      h("td", {}, value),
      h("td", {}, deviation),
      h("td", {}, true_),
    );
  // Deviations of the scale are relative; x is known unless the shape was estimated.
  const rows = [
    ...(estimate.warp ? [0, 1, 2] : [1, 2]).map((axis) =>
      row(
        `scale ${AXES[axis]}`,
        number(scale[axis], 4),
        std ? `\u00b1 ${quantity(100 * std.scale[axis], { digits: 2, unit: "%" })}` : number(null),
        number(truth?.scale[axis], 4),
      ),
    ),
    ...AXES.map((name, axis) =>
      row(
        `translation ${name}`,
        number(translation[axis], 4),
        std ? `\u00b1 ${number(std.translation[axis], 4)}` : number(null),
        number(truth?.translation[axis], 4),
      ),
    ),
    row(
      "rotation",
      "",
      std ? `\u00b1 ${quantity(std.rotation_deg, { digits: 2, unit: "\u00b0" })}` : number(null),
      "",
    ),
  ];
  return h(
    "div",
    { class: "scroller", tabindex: 0, role: "region", "aria-label": "estimate" },
    h(
      "table",
      {},
      h("caption", {}, `Estimate of ${label}`),
      h(
        "thead",
        {},
        h(
          "tr",
          {},
          ["", "estimate", "predicted std. deviation", "truth"].map((head) =>
            h("th", { scope: "col" }, head),
          ),
        ),
      ),
      h("tbody", {}, rows),
    ),
  );
}

/** Warnings of an estimate, in the fit's own words. */
export function warningList({ warnings = [] }) {
  if (!warnings.length) return null;
  return h(
    "section",
    { class: "warnings", "aria-label": "warnings" },
    h("h3", {}, warnings.length > 1 ? "Warnings" : "Warning"),
    h(
      "ul",
      {},
      warnings.map((words) => h("li", {}, words)),
    ),
  );
}

/** The other poses that explain the keypoints, to be drawn in place of the best. */
export function alternativeChoice({ alternatives = [] }, chosen, choose) {
  if (!alternatives.length) return null;
  const option = (index, ...words) =>
    h(
      "label",
      { class: "option" },
      h("input", {
        type: "radio",
        name: "alternative",
        checked: index === chosen,
        onchange: () => choose(index),
      }),
      words,
    );
  return h(
    "fieldset",
    { class: "alternatives" },
    h("legend", {}, "Poses that explain the keypoints"),
    option(0, "the best"),
    alternatives.map(({ likelihood, scale }, index) =>
      option(
        index + 1,
        `another: scale ${number(scale[1], 3)}, ${number(scale[2], 3)}; `,
        `likelihood ${number(likelihood, likelihood < 0.001 ? undefined : 3)} of the best's`,
      ),
    ),
  );
}
