// The keyboard. Keys that a view understands by itself when it has the focus are the view's.

import { TOOLS } from "./marking.js";

const TOOL_KEYS = Object.fromEntries(Object.entries(TOOLS).map(([name, { key }]) => [key, name]));
const NUDGE = 0.25;
const COARSE = 10;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const PAN = 40;
const SIDES = { 1: "front", 2: "right", 3: "back", 4: "left", 5: "top", 6: "bottom" };
const HELD = { h: (app, held) => app.hide(held), s: (app, held) => app.snap({ held }) };

/** @param {object} app - what the keys do; see main.js */
export function listen(app) {
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || document.querySelector("dialog[open]:not(.help)")) return;
    if (event.target.closest("input:not([type=checkbox]), select, textarea")) return;
    const held = !event.ctrlKey && !event.metaKey && !event.altKey && HELD[event.key.toLowerCase()];
    const done = held ? held(app, true) : event.ctrlKey || event.metaKey ? withControl(app, event) : plain(app, event);
    if (done) event.preventDefault();
  });
  document.addEventListener("keyup", (event) => HELD[event.key.toLowerCase()]?.(app, false));
  window.addEventListener("blur", () => Object.values(HELD).forEach((act) => act(app, false)));
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
      return app.escape();
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
    case "i":
    case "I":
      return app.usePhoto();
    case "l":
    case "L":
      return app.magnify();
    case "m":
    case "M":
      return app.mirror();
    case "o":
    case "O":
      return app.nextMode();
    case "v":
    case "V":
      return app.asPhoto();
    case "a":
    case "A":
      return app.accept();
    case "r":
    case "R":
      return app.showResult();
    case "t":
    case "T":
      return app.another();
    case "w":
    case "W":
      return app.showPhotos();
    case "d":
    case "D":
      return app.mark("done") && true;
    case "k":
    case "K":
      return app.mark("skipped") && true;
    case "?":
      return app.showHelp();
    case "PageUp":
      return app.go(-1);
    case "PageDown":
      return app.go(1);
    default:
      if (TOOL_KEYS[event.key.toLowerCase()]) return app.choose(TOOL_KEYS[event.key.toLowerCase()]);
      return SIDES[event.key] ? app.lookFrom(SIDES[event.key]) : false;
  }
}

function arrow(app, event, inPhoto) {
  const [x, y] = ARROWS[event.key];
  const step = event.shiftKey ? COARSE * NUDGE : NUDGE;
  if (app.nudge(x * step, y * step)) return true;
  if (inPhoto) app.photo.pan(-PAN * x, -PAN * y);
  return inPhoto;
}
