// Colours of the theme for what CSS does not reach: charts and WebGL. Paper is light.

const DARK = matchMedia("(prefers-color-scheme: dark)");
const root = document.documentElement;

addEventListener("beforeprint", () => (root.style.colorScheme = "light"));
addEventListener("afterprint", () => (root.style.colorScheme = ""));

export const isPrinting = () => root.style.colorScheme === "light";
export const isDark = () => DARK.matches && !isPrinting();

/** The value of one of theme.css's colours now, as `rgb(…)`. */
export function themeColor(name) {
  // A custom property keeps its light-dark() unresolved; a property that takes a colour does not.
  const probe = document.createElement("span");
  probe.style.color = `var(--${name})`;
  document.body.append(probe);
  const { color } = getComputedStyle(probe);
  probe.remove();
  return color;
}

/** Call back when the page turns light or dark, for paper too. */
export function onThemeChange(action) {
  DARK.addEventListener("change", action);
  addEventListener("beforeprint", action);
  addEventListener("afterprint", action);
}
