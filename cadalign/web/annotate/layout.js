// The page around the views: bar, line of status, help.
import { button, h } from "../common/dom.js";
import { HELP } from "./keys.js";

export class Layout {
  /** @param {object} handlers - act(action), go(by), goTo(number), boxing(), asPhoto(), photo and model: zoom(factor), fit() */
  constructor(handlers, panel) {
    const { act, go, goTo } = handlers;
    this.title = h("h1");
    this.saved = h("span", { class: "soft" });
    this.photos = h("select", { "aria-label": "Photo", onchange: () => goTo(Number(this.photos.value)) });
    this.previous = button("‹", () => go(-1), { "aria-label": "Previous photo", title: "Page up" });
    this.next = button("›", () => go(1), { "aria-label": "Next photo", title: "Page down" });
    this.nav = h("nav", { "aria-label": "Photos", hidden: true }, this.previous, this.photos, this.next);
    this.undo = button("Undo", () => act({ do: "undo" }), { title: "Ctrl+Z" });
    this.redo = button("Redo", () => act({ do: "redo" }), { title: "Ctrl+Y" });
    this.status = h("p", { class: "status", role: "status" });
    this.photo = h("div", { class: "host" });
    this.model = h("div", { class: "host" });
    this.box = button("Mask by a box", handlers.boxing, { title: "Drag a box around the object (X)", "aria-pressed": "false" });
    this.skip = button("Skip", () => act({ do: "skip" }), { title: "Propose another keypoint (S)" });
    this.asPhoto = button("As photo", handlers.asPhoto, { title: "Look from where the photo was taken (V)" });
    this.help = makeHelp();
    document.body.classList.add("waiting"); // for the first state, which says what there is
    document.body.append(
      h(
        "header",
        {},
        this.title,
        this.nav,
        this.saved,
        this.undo,
        this.redo,
        button("Help", () => this.showHelp(), { title: "?", "aria-haspopup": "dialog" }),
      ),
      h(
        "main",
        {},
        view("Photo", this.photo, handlers.photo, [this.skip, this.box]),
        view("Model", this.model, handlers.model, this.asPhoto),
        this.status,
        panel,
      ),
      this.help,
    );
  }

  show(state) {
    const { image, saved, alignment } = state;
    document.body.classList.remove("waiting");
    document.title = `${image.name} · cadalign annotate`;
    this.title.textContent = image.name;
    this.nav.hidden = image.count < 2;
    this.photos.value = image.number;
    this.previous.disabled = image.number === 0;
    this.next.disabled = image.number === image.count - 1;
    this.undo.disabled = !state.can_undo;
    this.redo.disabled = !state.can_redo;
    this.asPhoto.disabled = alignment.status !== "done";
    this.skip.hidden = !state.model.is_skeleton;
    this.box.hidden = !state.evidence.outline;
    this.saved.classList.toggle("wrong", Boolean(saved.trouble));
    this.saved.textContent = saved.trouble ? `Not saved: ${saved.trouble}` : `Every change is saved in ${saved.path}`;
    if (state.message) this.say(state.message);
    else this.say(progressOf(state), warningsOf(state));
  }

  /** List the photos of a folder with their numbers of pairs. */
  listPhotos(photos, current) {
    const option = ({ name, pairs }, number) => h("option", { value: number }, `${number + 1}. ${name}: ${pairs} pairs`);
    this.photos.replaceChildren(...photos.map(option));
    this.photos.value = current;
  }

  /** Show a text in the line of status, after warnings. */
  say(text, warnings = []) {
    const parts = warnings.map((warning) => h("strong", { class: "wrong" }, warning));
    this.status.replaceChildren(...parts.flatMap((part) => [part, " "]), text);
    this.status.title = this.status.textContent;
  }

  showBoxing(on) {
    this.box.setAttribute("aria-pressed", String(on));
    if (on) this.say("Drag a box around the object: it is cut out by its colours.");
  }

  /** Open the help, or close it. */
  showHelp() {
    if (this.help.open) this.help.close();
    else this.help.showModal();
  }
}

/** What stands beside the photo: pairs that contradict the others, and the first of the notes. */
function warningsOf({ pairs, alignment }) {
  const wrong = pairs.filter(({ off }) => off !== null);
  const texts = wrong.map(({ pair, off }) => `Pair ${pair} contradicts: ${off.toFixed(0)} px.`);
  return [...texts, ...(alignment.notes ?? []).slice(0, 1)];
}

/** What is missing to an alignment. */
function progressOf({ pairs, alignment, model, keypoints }) {
  if (model.is_skeleton && alignment.status !== "preparing") return `${askOf(pairs, model, keypoints)} ${alignment.message}`;
  const how = "Click a point in the photo and the same point on the model, in either order.";
  return pairs.length || alignment.status !== "none" ? alignment.message : `${how} ${alignment.message}`;
}

/** What to click on next, without a model. */
function askOf(pairs, { proposed }, keypoints) {
  const pending = pairs.find(({ uv, keypoint }) => uv === null || keypoint === null);
  if (pending?.keypoint === null) return `Pair ${pending.pair}: choose its keypoint on the right.`;
  if (pending) return `Click in the photo: ${pending.name}.`;
  const next = keypoints.find(({ keypoint }) => keypoint === proposed);
  if (next) return `Click in the photo: ${next.name}. Or choose another on the right; S skips it.`;
  return keypoints.every(({ used }) => used) ? "All keypoints are marked." : "The other keypoints were skipped. S proposes them again.";
}

function view(name, host, { zoom, fit }, tools) {
  const zooms = [
    button("−", () => zoom(1 / 1.4), { "aria-label": "Zoom out" }),
    button("+", () => zoom(1.4), { "aria-label": "Zoom in" }),
    button("Fit", fit, { "aria-label": `Fit the whole ${name.toLowerCase()}`, title: "F" }),
  ];
  return h("section", { class: "view", "aria-label": name }, host, h("div", { class: "tools" }, tools, zooms));
}

function makeHelp() {
  const rows = HELP.map(([key, text]) => h("div", {}, h("dt", {}, key), h("dd", {}, text)));
  const dialog = h(
    "dialog",
    { "aria-labelledby": "help-title" },
    h("h2", { id: "help-title" }, "Keys and mouse"),
    h("dl", {}, rows),
    h(
      "p",
      {},
      "Red is the model's box, blue its edges, orange arrows lead from a point to where the alignment puts it. Pink rings are estimated keypoints that are not marked, with the regions that hold them at 95 %.",
    ),
    button("Close", () => dialog.close()),
  );
  return dialog;
}
