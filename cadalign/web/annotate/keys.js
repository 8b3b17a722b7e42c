// The keyboard. Keys that a view understands by itself when it has the focus are the view's.

const NUDGE = 0.25; // [px of the photo]
const COARSE = 10;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const PAN = 40;
const ZOOMS = { "+": 1.25, "=": 1.25, "-": 0.8 };
const ACTIONS = {
  delete: (app) => app.deleteSelected(),
  backspace: (app) => app.deleteSelected(),
  escape: (app) => app.escape(),
  "[": (app) => app.step(-1),
  "]": (app) => app.step(1),
  f: (app) => [app.photo.fit(), app.model.frame()],
  i: (app) => app.state.evidence.outline && app.act({ do: "use_photo", on: !app.state.evidence.photo }),
  x: (app) => app.state.evidence.outline && app.boxing(!app.photo.isBoxing),
  h: (app) => app.hide(true),
  s: (app) => app.state.model.is_skeleton && app.act({ do: "skip" }),
  v: (app) => app.model.frameAsPhoto(),
  "?": (app) => app.layout.showHelp(),
  pageup: (app) => app.go(-1),
  pagedown: (app) => app.go(1),
};

/** The keys and what they do, for the help. */
export const HELP = [
  ["Click, then click", "the photo and the model at the same place, in either order: a pair"],
  ["Drag", "moves a point of the photo; beside points pans the photo, turns the model"],
  ["Wheel, + and −", "zoom"],
  ["Arrow keys", "nudge the selected point by 0.25 px, with Shift by 2.5 px; in the model they turn it"],
  ["Enter", "places a point at the middle of the view that has the focus"],
  ["[ and ]", "select the pair before and after"],
  ["Delete", "deletes the selected pair"],
  ["Ctrl+Z, Ctrl+Y", "undo, redo"],
  ["F", "shows all of the photo and the model"],
  ["V", "looks at the model from where the photo was taken"],
  ["S", "without a model: proposes another keypoint"],
  ["X", "lets the next drag in the photo draw a box: the object in it becomes the mask"],
  ["I", "fits to the photo itself, or no more: the outline is sought in it"],
  ["H held", "hides the alignment over the photo"],
  ["Page up, Page down", "the photo before and after"],
  ["Escape", "gives up the box, or selects nothing"],
  ["?", "this help"],
];

/** @param {object} app - of main.js; what the keys do returns false where there is nothing to do */
export function listen(app) {
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || !app.state || event.altKey) return;
    if (event.key !== "?" && document.querySelector("dialog[open]")) return;
    if (event.target.closest("input:not([type=checkbox]), select")) return;
    const act = event.ctrlKey || event.metaKey ? withControl : plain;
    if (act(app, event) !== false) event.preventDefault();
  });
  document.addEventListener("keyup", (event) => event.key.toLowerCase() === "h" && app.hide(false));
  window.addEventListener("blur", () => app.hide(false));
}

function withControl(app, event) {
  const key = event.key.toLowerCase();
  if (key === "z" && !event.shiftKey) return app.act({ do: "undo" });
  if (key === "y" || (key === "z" && event.shiftKey)) return app.act({ do: "redo" });
  return false;
}

function plain(app, event) {
  const { photo, model } = app;
  const key = event.key.toLowerCase();
  if (event.target !== model.canvas && ARROWS[event.key]) return arrow(app, event);
  if (key === "enter") {
    if (event.target === photo.canvas) return photo.place();
    return event.target === model.canvas && model.pickMiddle();
  }
  if (ZOOMS[key]) return event.target === photo.canvas && photo.zoom(ZOOMS[key]);
  return ACTIONS[key] ? ACTIONS[key](app) : false;
}

function arrow(app, event) {
  const [x, y] = ARROWS[event.key];
  const step = event.shiftKey ? COARSE * NUDGE : NUDGE;
  if (app.nudge(x * step, y * step)) return true;
  if (event.target !== app.photo.canvas) return false;
  return app.photo.pan(-PAN * x, -PAN * y);
}
