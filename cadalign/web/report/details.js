// Numbers of one instance: errors of all methods, the estimate with its uncertainty, warnings.
import { h, table } from "../common/dom.js";
import { radios } from "./choices.js";
import { named, number, quantity } from "./format.js";
import { swatch } from "./swatch.js";

const AXES = ["x", "y", "z"];

/** Table of all methods' errors on an instance. */
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
        h("th", { scope: "row" }, swatch(report, method), method.key),
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
  const heads = ["method", ...metrics.map(named), "residual [px]"];
  return table("Errors", heads, rows, { label: "errors by method" });
}

/** A method's estimate in an exhibit, or null. */
export const estimateOf = (exhibit, method) =>
  exhibit?.estimates?.find((estimate) => estimate.method === method) ?? null;

/** The estimate of a method beside the truth, with its predicted standard deviations. */
export function estimateTable(exhibit, estimate, label) {
  const { std, translation, scale } = estimate;
  const truth = exhibit.gt;
  const row = (name, ...cells) =>
    h("tr", {}, h("th", { scope: "row" }, name), cells.map((text) => h("td", {}, text)));
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
  const heads = ["", "estimate", "predicted std. deviation", "truth"];
  return table(`Estimate of ${label}`, heads, rows, { label: "estimate" });
}

/** List of an estimate's warnings, or null. */
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

/** Choice among the best pose and its alternatives. */
export function alternativeChoice({ alternatives = [] }, chosen, choose) {
  if (!alternatives.length) return null;
  const words = (index) => {
    if (!index) return "the best";
    const { likelihood, scale } = alternatives[index - 1];
    const share = number(likelihood, likelihood < 0.001 ? undefined : 3);
    return `another: scale ${number(scale[1], 3)}, ${number(scale[2], 3)}; likelihood ${share} of the best's`;
  };
  return radios("Poses that explain the keypoints", [0, ...alternatives.map((_, at) => at + 1)], {
    kind: "alternatives",
    checked: (index) => index === chosen,
    words,
    choose,
  });
}
