// Elements made in one call. Strings become text nodes, so that nothing from data is ever markup.

const SVG = "http://www.w3.org/2000/svg";

function dress(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, value);
  }
  element.append(...children.flat(2).filter((child) => child != null && child !== false));
  return element;
}

/**
 * An HTML element.
 *
 * @param {string} tag
 * @param {object} attributes - `onclick` and the like are listeners; false and null are left out
 * @param {...(Node|string|Array|null|false)} children - strings are shown as they stand
 */
export function h(tag, attributes = {}, ...children) {
  return dress(document.createElement(tag), attributes, children);
}

/** The same for an SVG element. */
export function svg(tag, attributes = {}, ...children) {
  return dress(document.createElementNS(SVG, tag), attributes, children);
}

/** A function that runs once its calls have ceased for some milliseconds. */
export function debounced(action, wait) {
  let timer = 0;
  return (...given) => {
    clearTimeout(timer);
    timer = setTimeout(() => action(...given), wait);
  };
}

/** A button. */
export function button(text, onclick, attributes = {}) {
  return h("button", { type: "button", onclick, ...attributes }, text);
}

/**
 * A table that scrolls in itself where it is too wide.
 *
 * @param {string} caption
 * @param {Array} heads - texts of the columns, or [text, class]; false ones are left out
 * @param {Node[]} rows
 * @param {object} options
 * @param {string} options.label - what a screen reader says of it, if not the caption
 * @param {boolean} options.hidden - whether only a screen reader says the caption
 */
export function table(caption, heads, rows, { label = caption, hidden = false } = {}) {
  const columns = heads.filter((head) => head !== false).map((head) => {
    const [text, words] = [head].flat();
    return h("th", { scope: "col", class: words }, text);
  });
  return h(
    "div",
    { class: "scroller", tabindex: 0, role: "region", "aria-label": label },
    h(
      "table",
      {},
      h("caption", { class: hidden && "visually-hidden" }, caption),
      h("thead", {}, h("tr", {}, columns)),
      h("tbody", {}, rows),
    ),
  );
}

/** A form's field: a control or several with their name. */
export const field = (label, ...controls) =>
  h("label", { class: "field" }, h("span", {}, label), controls);
