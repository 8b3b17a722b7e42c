// The page around the views: bar, messages, help.
import { button, h } from "../common/dom.js";

const KEYS = [
  ["Click, then click", "the photo and the model at the same place, in either order: a pair"],
  ["Drag a point", "moves it in the photo"],
  ["Drag beside points", "pans the photo, turns the model"],
  ["Wheel, pinch, + and −", "zoom"],
  ["Arrow keys", "nudge the selected point by 0.25 px, with Shift by 2.5 px; in the model they turn it"],
  ["Enter", "places a point at the middle of the view that has the focus"],
  ["[ and ]", "select the pair before and after"],
  ["N", "uses the suggested model point"],
  ["Delete", "deletes the selected pair"],
  ["Ctrl+Z, Ctrl+Y", "undo, redo"],
  ["F", "shows all of the photo and the model"],
  ["V", "looks at the model from where the photo was taken"],
  ["Page up, Page down", "the photo before and after"],
  ["Escape", "selects nothing"],
  ["?", "this help"],
];

export class Layout {
  /** @param {object} handlers - undo, redo, previous, next */
  constructor(handlers, panel) {
    this.title = h("h1");
    this.place = h("span", { class: "soft" });
    this.saved = h("span", { class: "saved", role: "status" });
    this.previous = button("‹ Previous", handlers.previous, { title: "Page up" });
    this.next = button("Next ›", handlers.next, { title: "Page down" });
    this.undo = button("Undo", handlers.undo, { title: "Ctrl+Z" });
    this.redo = button("Redo", handlers.redo, { title: "Ctrl+Y" });
    this.photos = h("nav", { "aria-label": "Photos" }, this.previous, this.place, this.next);
    this.help = helpDialog();
    this.message = h("p", { class: "message", role: "alert", hidden: true });
    this.photo = h("div", { class: "host" });
    this.model = h("div", { class: "host" });
    this.shown = h("span", { class: "soft" });
    this.asPhoto = button("As photo", handlers.asPhoto, { title: "Look from where the photo was taken (V)" });
    document.body.append(
      h(
        "header",
        {},
        this.title,
        this.photos,
        this.saved,
        h(
          "div",
          { class: "tools" },
          this.undo,
          this.redo,
          button("Help", () => this.help.showModal(), { title: "?", "aria-haspopup": "dialog" }),
        ),
      ),
      this.message,
      h(
        "main",
        {},
        view("Photo", this.photo, handlers.photo),
        view("Model", this.model, handlers.model, this.shown, this.asPhoto),
        panel,
      ),
      this.help,
    );
  }

  show(state) {
    const { image, saved } = state;
    document.title = `${image.name} · cadalign annotate`;
    this.title.textContent = image.name;
    this.photos.hidden = image.count < 2;
    this.place.textContent = `${image.number + 1} of ${image.count}`;
    this.previous.disabled = image.number === 0;
    this.next.disabled = image.number === image.count - 1;
    this.undo.disabled = !state.can_undo;
    this.redo.disabled = !state.can_redo;
    this.asPhoto.hidden = state.alignment.status !== "done";
    this.saved.classList.toggle("trouble", Boolean(saved.trouble));
    this.saved.textContent = savedText(saved);
    if (state.message) this.tell(state.message);
  }

  /** Say something, or with "" nothing any more. */
  tell(text) {
    this.message.textContent = text;
    this.message.hidden = !text;
  }
}

function savedText({ path, at, trouble }) {
  if (trouble) return `Not saved: ${trouble}`;
  if (at === null) return `Saves to ${path}`;
  return `Saved to ${path} at ${new Date(1000 * at).toLocaleTimeString()}`;
}

function view(name, host, { zoom, fit }, ...extra) {
  const tools = h(
    "div",
    { class: "zoom", role: "group", "aria-label": `Zoom of the ${name.toLowerCase()}` },
    extra,
    button("−", () => zoom(1 / 1.4), { "aria-label": "Zoom out" }),
    button("+", () => zoom(1.4), { "aria-label": "Zoom in" }),
    button("Fit", fit, { "aria-label": `Show the whole ${name.toLowerCase()}` }),
  );
  return h("section", { class: "view", "aria-label": name }, h("h2", {}, name), tools, host);
}

function helpDialog() {
  const rows = KEYS.map(([key, text]) => h("div", {}, h("dt", {}, key), h("dd", {}, text)));
  const dialog = h("dialog", { "aria-labelledby": "help-title" });
  dialog.append(
    h("h2", { id: "help-title" }, "Keys and mouse"),
    h("dl", {}, rows),
    h(
      "p",
      {},
      "Red is the model's box, blue its edges, orange arrows lead from a point to where the alignment puts it. Pink rings are estimated keypoints that are not marked, with the regions that hold them at 95 %. Every change is saved at once.",
    ),
    button("Close", () => dialog.close()),
  );
  return dialog;
}
