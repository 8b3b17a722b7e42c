import "../common/theme.css";
import "./page.css";
import "./results.css";
import "./gallery.css";
import "./viewer.css";
import "./print.css";
import { button, h } from "../common/dom.js";
import { switches } from "./filters.js";
import { Gallery } from "./gallery.js";
import { heading, headline } from "./headline.js";
import { Report, readPayload } from "./payload.js";
import { plotSection } from "./plots.js";
import { State } from "./state.js";
import { Viewer } from "./viewer.js";

const report = new Report(readPayload());
const state = new State();
document.title = report.title;

const open = (instance) => viewer.open(instance);
const gallery = report.instances.length ? new Gallery(report, state, { open }) : null;
const plots = plotSection(report, state);

// A demo starts with pictures, an evaluation with numbers.
const showsPictures = report.runs.every(({ what }) => what === "demo");
const results = [headline(report), plots];
const sections = (
  showsPictures ? [gallery?.element, ...results] : [...results, gallery?.element]
).filter(Boolean);
const links = sections.map((section) =>
  // Buttons, not links: the fragment of the URL holds the state.
  button(section.querySelector("h2").textContent, () => section.scrollIntoView()),
);
const bar = h(
  "nav",
  { class: "bar", "aria-label": "sections and what they show" },
  h("div", { class: "links" }, links),
  (plots || gallery) && switches(report, state),
);
document.body.append(h("div", { class: "page" }, heading(report), bar, h("main", {}, sections)));
// Sections scroll to below the bar.
new ResizeObserver(() => {
  document.documentElement.style.setProperty("--bar", `${bar.offsetHeight}px`);
}).observe(bar);

const viewer = gallery && new Viewer(report, state, { list: () => gallery.found });
document.documentElement.dataset.ready = "";
