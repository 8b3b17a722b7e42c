// The keyboard. Keys that a view understands by itself when it has the focus are the view's.

import { TOOLS } from "./marking.js";

const TOOL_KEYS = Object.fromEntries(Object.entries(TOOLS).map(([name, { key }]) => [key, name]));
const NUDGE = 0.25;
const COARSE = 10;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const PAN = 40;
// ShapeNet's models face -z, with y up: front, right, back, left, top, bottom. None is looked at
// straight along y, where left is undefined.
const SIDES = {
  1: [0, 0, -1], 2: [-1, 0, 0], 3: [0, 0, 1], 4: [1, 0, 0], 5: [0, 1, -0.001], 6: [0, -1, -0.001],
};
const ZOOMS = { "+": 1.25, "=": 1.25, "-": 0.8 };
const ACTIONS = {
  delete: (app) => app.deleteSelected(),
  backspace: (app) => app.deleteSelected(),
  escape: (app) => app.escape(),
  "[": (app) => app.step(-1),
  "]": (app) => app.step(1),
  n: (app) => app.suggested(),
  f: (app) => [app.photo.fit(), app.model.frame()],
  i: (app) => app.act({ do: "use_photo", on: !app.state.evidence.photo }),
  l: (app) => app.magnify(),
  o: (app) => app.layout.overlay.next(),
  v: (app) => app.model.frameAsPhoto(),
  r: (app) => app.showResult(),
  w: (app) => app.showPhotos(),
  "?": (app) => app.layout.showHelp(),
  pageup: (app) => app.go(-1),
  pagedown: (app) => app.go(1),
};
const HELD = { h: (app, hidden) => app.photo.setOverlay({ hidden }), s: (app, held) => app.snap({ held }) };

/** @param {object} app - of main.js; what the keys do returns false where there is nothing to do */
export function listen(app) {
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || document.querySelector("dialog[open]:not(.help)")) return;
    if (event.target.closest("input:not([type=checkbox]), select, textarea")) return;
    const held = !event.ctrlKey && !event.metaKey && !event.altKey && HELD[event.key.toLowerCase()];
    const done = held ? held(app, true) : event.ctrlKey || event.metaKey ? withControl(app, event) : plain(app, event);
    if (done !== false) event.preventDefault();
  });
  document.addEventListener("keyup", (event) => HELD[event.key.toLowerCase()]?.(app, false));
  window.addEventListener("blur", () => Object.values(HELD).forEach((act) => act(app, false)));
}

function withControl(app, event) {
  const key = event.key.toLowerCase();
  if (key === "z" && !event.shiftKey) return app.act({ do: "undo" });
  if (key === "y" || (key === "z" && event.shiftKey)) return app.act({ do: "redo" });
  return false;
}

function plain(app, event) {
  if (event.altKey) return false;
  const { photo, model } = app;
  const inModel = event.target === model.stage.canvas;
  const inPhoto = event.target === photo.canvas;
  if (ARROWS[event.key] && !inModel) return arrow(app, event, inPhoto);
  const key = event.key.toLowerCase();
  if (key === "enter") {
    if (inPhoto) return app.placeMiddle();
    return inModel && model.pickMiddle();
  }
  if (ZOOMS[key]) return inPhoto && photo.zoom(ZOOMS[key]);
  if (TOOL_KEYS[key]) return app.choose(TOOL_KEYS[key]);
  if (SIDES[key]) return model.frameFrom(SIDES[key]);
  return ACTIONS[key] ? ACTIONS[key](app) : false;
}

function arrow(app, event, inPhoto) {
  const [x, y] = ARROWS[event.key];
  const step = event.shiftKey ? COARSE * NUDGE : NUDGE;
  if (app.mover.nudge(x * step, y * step)) return true;
  if (inPhoto) app.photo.pan(-PAN * x, -PAN * y);
  return inPhoto;
}
