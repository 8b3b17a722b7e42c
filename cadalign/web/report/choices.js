// Choices of one among several, made anew with what they stand in.
import { h } from "../common/dom.js";

/** Put new contents in, and the focus back to the choice it was on. */
export function refill(host, parts) {
  const name = host.contains(document.activeElement) ? document.activeElement.name : "";
  host.replaceChildren(...parts.filter(Boolean));
  if (name) host.querySelector(`[name="${name}"]:checked`)?.focus();
}

/** A choice of one thing by radio buttons. */
export function radios(legend, things, { checked, words, choose, kind = "radios" }) {
  return h(
    "fieldset",
    { class: kind },
    h("legend", {}, legend),
    things.map((thing) =>
      h(
        "label",
        { class: "option" },
        h("input", {
          type: "radio",
          name: legend,
          checked: checked(thing),
          onchange: () => choose(thing),
        }),
        words(thing),
      ),
    ),
  );
}
