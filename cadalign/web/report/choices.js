// Radio buttons, and updates of their container.
import { h } from "../common/dom.js";

/** Replace the contents of an element, and keep the focus on its radio button. */
export function refill(host, parts) {
  const name = host.contains(document.activeElement) ? document.activeElement.name : "";
  host.replaceChildren(...parts.filter(Boolean));
  if (name) host.querySelector(`[name="${name}"]:checked`)?.focus();
}

/** Radio buttons. */
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
