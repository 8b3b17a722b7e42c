// The annotator: photo on the left, model on the right, results below. All that lasts is the state,
// which the server makes of the observation file.
import "../common/theme.css";
import "./annotate.css";
import { Api, fetched } from "./api.js";
import { listen } from "./keys.js";
import { Layout } from "./layout.js";
import { ModelView } from "./model_view.js";
import { Panel } from "./panel.js";
import { PhotoView } from "./photo_view.js";

const POLL = 400; // while the solvers are being prepared [ms]
const PAUSE = 500; // nudges that follow each other faster are one change [ms]

class App {
  constructor() {
    this.state = null;
    this.selected = null;
    this.opened = null; // number of the photo that is shown
    const say = (text) => this.layout.say(text);
    this.api = new Api({
      onState: (state) => this.show(state),
      onTrouble: say,
      onWorking: () => say("Working…"),
    });
    const act = (action, selected) => this.act(action, selected);
    const select = (pair) => this.select(pair);
    this.panel = new Panel({ act, select });
    this.layout = new Layout(
      {
        act,
        go: (by) => this.go(by),
        goTo: (number) => this.goTo(number),
        boxing: () => this.boxing(!this.photo.isBoxing),
        asPhoto: () => this.model.frameAsPhoto(),
        photo: { zoom: (factor) => this.photo.zoom(factor), fit: () => this.photo.fit() },
        model: { zoom: (factor) => this.model.zoom(factor), fit: () => this.model.frame() },
      },
      this.panel.root,
    );
    this.photo = new PhotoView(this.layout.photo, {
      onPlace: (uv) => this.place(uv),
      onTake: (keypoint, uv) => act({ do: "take", keypoint, uv }),
      onMove: (pair, uv) => act({ do: "move", pair, uv }),
      onBox: (corners) => {
        this.boxing(false);
        act({ do: "mask_cut", corners });
      },
      onSelect: select,
      onTrouble: say,
    });
    this.model = new ModelView(this.layout.model, {
      onPick: (aim) => act({ do: "pick", ...aim, pair: this.selected }),
      onSelect: select,
    });
    listen(this);
    window.addEventListener("hashchange", () => this.open());
    window.addEventListener("focus", () => this.idle && this.state && this.api.refresh());
  }

  /** Show the model of a photo: without a CAD model, each may have another. */
  async loadModel({ image, model }) {
    try {
      await this.model.load(image.number, model);
    } catch (error) {
      this.layout.say(`The model cannot be shown: ${error.message}`);
    }
  }

  /** Whether nothing is under way. */
  get idle() {
    return this.api.waiting === 0 && !this.nudging;
  }

  /** Show the photo that the address names: #3, counted from 1. */
  open() {
    const number = Math.max(0, (parseInt(location.hash.slice(1), 10) || 1) - 1);
    this.commit();
    this.selected = this.opened = null;
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
      if (image.count > 1) this.listPhotos();
    }
    this.loadModel(state);
    if (state.selected !== null) this.selected = state.selected;
    if (!state.pairs.some(({ pair }) => pair === this.selected)) this.selected = null;
    this.layout.show(state);
    this.draw();
    if (state.alignment.status === "preparing") setTimeout(() => this.api.refresh(), POLL);
  }

  draw() {
    this.photo.show(this.state, this.selected);
    if (this.nudging) this.photo.drag(this.nudging.pair, this.nudging.uv);
    this.model.show(this.state, this.selected);
    this.panel.show(this.state, this.selected);
  }

  async listPhotos() {
    const { number } = this.state.image;
    try {
      this.layout.listPhotos(await (await fetched("photos")).json(), number);
    } catch (error) {
      this.layout.say(error.message);
    }
  }

  /** Do an action; the time until its result is drawn is kept in `redrawn` [ms]. */
  async act(action, selected) {
    this.commit();
    const start = performance.now();
    if (selected !== undefined) this.selected = selected;
    const state = await this.api.act(action);
    if (!state) return this.draw(); // as it was
    await new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)));
    this.redrawn = performance.now() - start;
  }

  /** Place a point in the photo: of the pair that lacks it, or of the proposed keypoint. */
  place(uv) {
    const { pairs, model } = this.state;
    const isPending = pairs.some((pair) => pair.uv === null);
    if (isPending || model.proposed === null) return this.act({ do: "place_uv", uv, pair: this.selected });
    return this.act({ do: "take", keypoint: model.proposed, uv });
  }

  select(pair) {
    this.commit();
    this.selected = pair;
    this.draw();
  }

  /** Select the pair some places on. */
  step(by) {
    const { pairs } = this.state;
    if (!pairs.length) return;
    const at = pairs.findIndex(({ pair }) => pair === this.selected);
    const next = at < 0 ? (by > 0 ? 0 : pairs.length - 1) : (at + by + pairs.length) % pairs.length;
    this.select(pairs[next].pair);
  }

  deleteSelected() {
    return this.selected !== null && this.act({ do: "delete", pair: this.selected });
  }

  /** Move the selected point a little; says whether there is one. */
  nudge(x, y) {
    const pair = this.state.pairs.find((each) => each.pair === this.selected);
    if (!pair?.uv) return false;
    const [u, v] = this.nudging?.uv ?? pair.uv;
    clearTimeout(this.nudging?.timer);
    const timer = setTimeout(() => this.commit(), PAUSE);
    this.nudging = { pair: pair.pair, uv: this.photo.clamp([u + x, v + y]), timer };
    this.photo.drag(pair.pair, this.nudging.uv);
    return true;
  }

  /** Save where the selected point was nudged to. */
  commit() {
    if (!this.nudging) return;
    const { pair, uv, timer } = this.nudging;
    clearTimeout(timer);
    this.nudging = null;
    this.api.act({ do: "move", pair, uv });
  }

  boxing(on) {
    this.photo.boxing(on);
    if (!on) this.layout.show(this.state);
    this.layout.showBoxing(on);
  }

  /** Give up the box, or else the selection. */
  escape() {
    if (this.photo.isBoxing) this.boxing(false);
    else this.select(null);
  }

  hide(hidden) {
    this.photo.hidden = hidden;
    this.photo.invalidate();
  }

  /** Go to the photo some places on. */
  go(by) {
    const { number, count } = this.state.image;
    if (number + by < 0 || number + by >= count) return false;
    return this.goTo(number + by);
  }

  goTo(number) {
    location.hash = String(number + 1);
  }
}

window.annotator = new App();
window.annotator.open();
