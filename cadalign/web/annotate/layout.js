// The page around the views: bar, messages, help.
import { button, h } from "../common/dom.js";
import { TOOLS } from "./marking.js";

const KEYS = [
  ["Click, then click", "the photo and the model at the same place, in either order: a pair"],
  ["Drag a point", "moves it, in the photo and on the model"],
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
  ["1 to 6", "look at the model from its front, right, back, left, top, bottom"],
  ["S held", "snaps clicks and drags on the model to corners, creases and silhouette"],
  ["L", "a loupe beside the pointer, or none"],
  ["P X", "what is marked in the photo: points; the mask by a box"],
  ["I", "fits to the photo itself, too, or no more: the outline is sought in it"],
  ["Right button", "pans the photo while a box is drawn"],
  ["H held", "hides the alignment over the photo"],
  ["R", "shows the aligned model before the photo in 3D, or the model to click on again"],
  ["O", "draws the alignment as edges, shaded, as a box, or not"],
  ["Page up, Page down", "the photo before and after"],
  ["W", "the list of photos"],
  ["Escape", "gives up what is begun, goes back to points, selects nothing"],
  ["?", "this help"],
];

const WORKING = "Working…";

export class Layout {
  /** @param {object} handlers - undo, redo, previous, next */
  constructor(handlers, panel) {
    this.title = h("h1");
    this.place = h("span", { class: "soft count" });
    this.saved = h("span", { class: "saved", role: "status" });
    this.previous = button("‹ Previous", handlers.previous, { title: "Page up" });
    this.next = button("Next ›", handlers.next, { title: "Page down" });
    this.undo = button("Undo", handlers.undo, { title: "Ctrl+Z" });
    this.redo = button("Redo", handlers.redo, { title: "Ctrl+Y" });
    this.list = button("Photos…", handlers.list, { title: "All photos (W)", "aria-haspopup": "dialog" });
    this.photos = h("nav", { "aria-label": "Photos" }, this.previous, this.place, this.next, this.list);
    this.help = helpDialog(handlers.tour);
    this.message = h("p", { class: "message", role: "alert", hidden: true });
    this.photo = h("div", { class: "host" });
    this.model = h("div", { class: "host" });
    this.overlay = makeOverlay(handlers.overlay);
    this.tools = makeTools(handlers);
    this.shown = h("span", { class: "soft" });
    this.snapping = toggle("Snap", handlers.snap, { title: "Clicks go to corners, creases and silhouette (hold S)" });
    this.loupe = toggle("Loupe", handlers.loupe, { title: "Magnify about the pointer (L)" });
    this.result = toggle("Result", handlers.result, { title: "The aligned model before the photo, in 3D (R)" });
    this.asPhoto = button("As photo", handlers.asPhoto, { title: "Look from where the photo was taken (V)" });
    document.body.classList.add("waiting"); // for the first state, which says what there is
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
          this.snapping,
          this.loupe,
          this.undo,
          this.redo,
          button("Help", () => this.showHelp(), { title: "?", "aria-haspopup": "dialog" }),
        ),
      ),
      this.message,
      h(
        "main",
        {},
        view("Photo", this.photo, handlers.photo, {
          above: h("div", { class: "above" }, this.tools.root),
          below: this.overlay.root,
        }),
        view("Model", this.model, handlers.model, { below: [this.shown, this.result, this.asPhoto] }),
        panel,
      ),
    );
    this.model.before(this.help); // beside the photo, which stays in sight
  }

  show(state) {
    const { image, saved } = state;
    document.body.classList.remove("waiting");
    document.title = `${image.name} · cadalign annotate`;
    this.title.textContent = image.name;
    this.photos.hidden = image.count < 2;
    this.place.textContent = `${image.number + 1} of ${image.count}`;
    this.previous.disabled = image.number === 0;
    this.next.disabled = image.number === image.count - 1;
    this.undo.disabled = !state.can_undo;
    this.redo.disabled = !state.can_redo;
    this.asPhoto.hidden = state.alignment.status !== "done";
    this.result.hidden = state.alignment.status !== "done" || state.alignment.camera_from_page === null;
    this.saved.classList.toggle("trouble", Boolean(saved.trouble));
    this.saved.textContent = savedText(saved);
    if (state.message) this.tell(state.message);
  }

  /** Say in the place of the last save that an answer is waited for, or no more. */
  showWorking(on) {
    if (on) [this.before, this.saved.textContent] = [this.saved.textContent, WORKING];
    else if (this.saved.textContent === WORKING) this.saved.textContent = this.before;
  }

  /** Open the help at its beginning, or close it. */
  showHelp() {
    if (this.help.open) this.help.close();
    else this.help.show();
    this.help.scrollTop = 0;
  }

  showSnapping(on, active) {
    press(this.snapping, on);
    this.snapping.classList.toggle("active", active);
  }

  /** Say something, or with "" nothing any more. */
  tell(text) {
    this.message.textContent = text;
    this.message.hidden = !text;
  }
}

/** What clicks in the photo mark. */
function makeTools({ tool: onChoose }) {
  const options = Object.entries(TOOLS).map(([name, { label, key }]) =>
    h("option", { value: name }, `${label} (${key.toUpperCase()})`),
  );
  const choice = h("select", { "aria-label": "What a click in the photo marks", onchange: () => onChoose(choice.value) }, options);
  const root = h("div", { class: "marking" }, choice);
  const show = (name) => {
    choice.value = name;
    // A new element, which does not count as one that has moved.
    root.replaceChildren(choice, h("span", { class: "soft" }, TOOLS[name].how));
  };
  show("points");
  return { root, show };
}

/** How the alignment is drawn over the photo: a choice and a slider. */
function makeOverlay(onChange) {
  const modes = ["edges", "shaded", "box", "off"];
  const mode = h(
    "select",
    { "aria-label": "Alignment over the photo", title: "O", onchange: () => onChange({ mode: mode.value }) },
    modes.map((name) => h("option", { value: name }, name)),
  );
  const opacity = h("input", {
    type: "range", min: "0.1", max: "1", step: "0.05", value: "1",
    "aria-label": "Opacity of the alignment", title: "Opacity; H hides while held",
    oninput: () => onChange({ opacity: Number(opacity.value) }),
  });
  const next = () => {
    mode.value = modes[(modes.indexOf(mode.value) + 1) % modes.length];
    onChange({ mode: mode.value });
  };
  return { root: h("span", { class: "overlay" }, mode, opacity), next };
}

/** A button that is on or off. */
function toggle(text, onChange, attributes) {
  const made = button(text, () => onChange(made.getAttribute("aria-pressed") !== "true"), attributes);
  press(made, false);
  return made;
}

/** Show a toggle as on or off. */
export function press(made, on) {
  made.setAttribute("aria-pressed", String(on));
}

function savedText({ path, at, trouble }) {
  if (trouble) return `Not saved: ${trouble}`;
  if (at === null) return `Saves to ${path}`;
  return `Saved to ${path} at ${new Date(1000 * at).toLocaleTimeString()}`;
}

function view(name, host, { zoom, fit }, { above = null, below }) {
  const tools = h(
    "div",
    { class: "zoom", role: "group", "aria-label": `Zoom of the ${name.toLowerCase()}` },
    below,
    button("−", () => zoom(1 / 1.4), { "aria-label": "Zoom out" }),
    button("+", () => zoom(1.4), { "aria-label": "Zoom in" }),
    button("Fit", fit, { "aria-label": `Fit the whole ${name.toLowerCase()}` }),
  );
  return h("section", { class: "view", "aria-label": name }, h("h2", {}, name), above, tools, host);
}

function helpDialog(onTour) {
  const rows = KEYS.map(([key, text]) => h("div", {}, h("dt", {}, key), h("dd", {}, text)));
  const dialog = h("dialog", { class: "help", "aria-labelledby": "help-title" });
  dialog.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    event.stopPropagation();
    dialog.close();
  });
  dialog.append(
    h("h2", { id: "help-title", tabindex: "-1", autofocus: true }, "Keys and mouse"),
    h("dl", {}, rows),
    h(
      "p",
      {},
      "Red is the model's box, blue its edges, orange arrows lead from a point to where the alignment puts it. Pink rings are estimated keypoints that are not marked, with the regions that hold them at 95 %. Every change is saved at once.",
    ),
    button("Close", () => dialog.close()),
    " ",
    button("Show the tour", () => {
      dialog.close();
      onTour();
    }),
  );
  return dialog;
}
