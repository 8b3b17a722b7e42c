// The keyboard. Keys that a view understands by itself when it has the focus are the view's.

const NUDGE = 0.25;
const COARSE = 10;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const PAN = 40;

/** @param {object} app - what the keys do; see main.js */
export function listen(app) {
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || document.querySelector("dialog[open]")) return;
    if (event.target.closest("input, select, textarea")) return;
    const done = event.ctrlKey || event.metaKey ? withControl(app, event) : plain(app, event);
    if (done) event.preventDefault();
  });
}

function withControl(app, event) {
  const key = event.key.toLowerCase();
  if (key === "z" && !event.shiftKey) return app.undo();
  if (key === "y" || (key === "z" && event.shiftKey)) return app.redo();
  return false;
}

function plain(app, event) {
  if (event.altKey) return false;
  const { photo, model } = app;
  const inModel = event.target === model.stage.canvas;
  const inPhoto = event.target === photo.canvas;
  if (ARROWS[event.key] && !inModel) return arrow(app, event, inPhoto);
  switch (event.key) {
    case "Enter":
      if (inPhoto) return app.placeMiddle();
      if (inModel) return model.pickMiddle() ?? true;
      return false;
    case "+":
    case "=":
      return inPhoto && (photo.zoom(1.25) ?? true);
    case "-":
      return inPhoto && (photo.zoom(0.8) ?? true);
    case "Delete":
    case "Backspace":
      return app.deleteSelected();
    case "Escape":
      return app.select(null);
    case "[":
      return app.step(-1);
    case "]":
      return app.step(1);
    case "n":
    case "N":
      return app.suggested();
    case "f":
    case "F":
      return app.fit();
    case "v":
    case "V":
      return app.asPhoto();
    case "?":
      return app.showHelp();
    case "PageUp":
      return app.go(-1);
    case "PageDown":
      return app.go(1);
    default:
      return false;
  }
}

function arrow(app, event, inPhoto) {
  const [x, y] = ARROWS[event.key];
  const step = event.shiftKey ? COARSE * NUDGE : NUDGE;
  if (app.nudge(x * step, y * step)) return true;
  if (inPhoto) app.photo.pan(-PAN * x, -PAN * y);
  return inPhoto;
}
