// The annotator: photo on the left, model on the right, results below.
import "../common/theme.css";
import "./annotate.css";
import { debounced } from "../common/dom.js";
import { Api } from "./api.js";
import { listen } from "./keys.js";
import { Layout } from "./layout.js";
import { ModelView } from "./model_view.js";
import { Panel } from "./panel.js";
import { PhotoView } from "./photo_view.js";

const POLL = 400; // while the solvers are being prepared [ms]
const PAUSE = 800; // nudges that follow each other faster are undone together [ms]
const REST = 300; // without a change, until what to add next is ranked [ms]

class App {
  constructor() {
    this.state = null;
    this.selected = null;
    this.gesture = Math.floor(Math.random() * 2 ** 40); // another than in other tabs
    this.api = new Api({
      onState: (state) => this.show(state),
      onTrouble: (text) => this.layout.tell(text),
    });
    const act = (action, select) => this.act(action, select);
    this.askSoon = debounced(() => this.ask(), REST);
    this.panel = new Panel({ act, select: (pair) => this.select(pair), suggested: () => this.suggested() });
    this.layout = new Layout(
      {
        undo: () => this.undo(),
        redo: () => this.redo(),
        previous: () => this.go(-1),
        next: () => this.go(1),
        asPhoto: () => this.asPhoto(),
        photo: { zoom: (factor) => this.photo.zoom(factor), fit: () => this.photo.fit() },
        model: { zoom: (factor) => this.model.zoom(factor), fit: () => this.model.frame() },
      },
      this.panel.root,
    );
    this.photo = new PhotoView(this.layout.photo, {
      onPlace: (uv) => this.act({ do: "place_uv", uv, pair: this.selected }),
      onSelect: (pair) => this.select(pair),
      onMove: (pair, uv, done) => this.drag(pair, uv, done),
      onTrouble: (text) => this.layout.tell(text),
    });
    this.model = new ModelView(this.layout.model, {
      onPick: (ray) => this.act({ do: "pick", ...ray, pair: this.selected }),
      onSelect: (pair) => this.select(pair),
      onSuggested: () => this.suggested(),
    });
    listen(this);
    window.addEventListener("hashchange", () => this.open());
    window.addEventListener("focus", () => this.api.idle && this.state && this.api.refresh());
  }

  async start() {
    const opened = this.open();
    try {
      const { shown, all } = await this.model.load();
      const some = shown < all;
      this.layout.shown.textContent = some
        ? `${shown.toLocaleString()} of ${all.toLocaleString()} faces shown, clicks are exact`
        : "";
    } catch (error) {
      this.layout.tell(`The model cannot be shown: ${error.message}`);
    }
    await opened;
  }

  /** Show the photo that the address names. */
  open() {
    const number = Math.max(0, (parseInt(location.hash.slice(1), 10) || 1) - 1);
    this.selected = null;
    this.opened = null;
    // The token has done its work: it stays out of the history and of what is copied.
    history.replaceState(null, "", `/${location.hash}`);
    return this.api.open(number);
  }

  /** Show a new state. */
  show(state) {
    this.state = state;
    const { image } = state;
    if (this.opened !== image.number) {
      this.opened = image.number;
      this.photo.open(image.number, image);
    }
    if (state.selected !== null) this.selected = state.selected;
    if (!state.pairs.some((pair) => pair.pair === this.selected)) this.selected = null;
    this.layout.show(state);
    this.draw();
    if (state.alignment.status === "done") this.askSoon();
    if (state.alignment.status === "preparing") setTimeout(() => this.api.refresh(), POLL);
  }

  draw() {
    this.photo.show(this.state, this.selected);
    this.model.show(this.state, this.selected);
    this.panel.show(this.state, this.selected);
    this.panel.showRanking(this.ranked, this.isCurrent(this.ranked));
  }

  /** Ask what to add next, unless that is known; an answer that comes too late is dropped. */
  async ask() {
    if (this.isCurrent(this.ranked)) return;
    const { number } = this.state.image;
    const answer = await this.api.advice(number);
    const ranked = answer && { ...answer, number };
    if (!this.isCurrent(ranked)) return;
    this.ranked = ranked;
    this.panel.showRanking(ranked, true);
  }

  /** Whether a ranking is that of the annotation that is shown. */
  isCurrent(ranked) {
    const { image, revision } = this.state;
    return ranked?.number === image.number && ranked.revision === revision;
  }

  /** Do an action; the time until its result is drawn is kept in `redrawn` [ms]. */
  async act(action, select) {
    const start = performance.now();
    if (select !== undefined) this.selected = select;
    const state = await this.api.act(action);
    if (!state) return null;
    await new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)));
    this.redrawn = performance.now() - start;
    return state;
  }

  select(pair) {
    this.selected = pair;
    this.draw();
    return true;
  }

  /** Select the pair some places on. */
  step(by) {
    const { pairs } = this.state;
    if (!pairs.length) return true;
    const at = pairs.findIndex((pair) => pair.pair === this.selected);
    const next = at < 0 ? (by > 0 ? 0 : pairs.length - 1) : (at + by + pairs.length) % pairs.length;
    return this.select(pairs[next].pair);
  }

  /** Follow a point that is dragged: one request under way at a time, the last place wins. */
  async drag(pair, uv, done) {
    if (!this.dragging) this.gesture += 1;
    this.dragging = !done;
    this.selected = pair;
    this.draggedTo = { pair, uv, done };
    if (this.following) return;
    this.following = true;
    while (this.draggedTo) {
      const { done: last, ...move } = this.draggedTo;
      this.draggedTo = null;
      await this.api.act({ do: "move", gesture: this.gesture, ...move });
      if (last) this.photo.dragged = null;
      this.photo.invalidate();
    }
    this.following = false;
  }

  nudge(x, y) {
    const pair = this.state?.pairs.find((one) => one.pair === this.selected);
    if (!pair?.uv) return false;
    const now = performance.now();
    if (!(now - this.nudgedAt < PAUSE) || this.nudged?.pair !== pair.pair) this.gesture += 1;
    this.nudgedAt = now;
    // Answers to earlier nudges may still be on their way: go on from where the last one led.
    const under = this.nudged?.pair === pair.pair && this.nudged.waiting > 0;
    const from = under ? this.nudged.uv : pair.uv;
    this.nudged = {
      pair: pair.pair,
      uv: this.photo.clamp([from[0] + x, from[1] + y]),
      waiting: (under ? this.nudged.waiting : 0) + 1,
    };
    const { uv } = this.nudged;
    this.photo.dragged = { pair: pair.pair, uv };
    this.photo.invalidate();
    this.act({ do: "move", pair: pair.pair, uv, gesture: this.gesture }).then(() => {
      if (this.nudged?.pair !== pair.pair) return;
      this.nudged.waiting -= 1;
      if (this.nudged.waiting === 0) this.photo.dragged = null;
      this.photo.invalidate();
    });
    return true;
  }

  deleteSelected() {
    if (this.selected === null) return false;
    this.act({ do: "delete", pair: this.selected });
    return true;
  }

  placeMiddle() {
    const uv = this.photo.toPixel(this.photo.middle);
    if (this.photo.contains(uv)) this.act({ do: "place_uv", uv, pair: this.selected });
    return true;
  }

  suggested() {
    if (this.state?.suggestion) this.act({ do: "suggested", pair: this.selected });
    return true;
  }

  undo() {
    this.act({ do: "undo" });
    return true;
  }

  redo() {
    this.act({ do: "redo" });
    return true;
  }

  fit() {
    this.photo.fit();
    this.model.frame();
    return true;
  }

  asPhoto() {
    this.model.frameAsPhoto();
    return true;
  }

  showHelp() {
    this.layout.help.showModal();
    return true;
  }

  /** Go to the photo some places on. */
  go(by) {
    const { image } = this.state ?? { image: { number: 0, count: 1 } };
    const number = image.number + by;
    if (number < 0 || number >= image.count) return false;
    location.hash = String(number + 1);
    return true;
  }
}

window.annotator = new App();
window.annotator.start();
