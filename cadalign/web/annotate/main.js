// The annotator: photo on the left, model on the right, results below.
import "../common/theme.css";
import "./annotate.css";
import { Api } from "./api.js";
import { listen } from "./keys.js";
import { Layout, press } from "./layout.js";
import { ModelView } from "./model_view.js";
import { Mover } from "./mover.js";
import { Panel } from "./panel.js";
import { ShadedOverlay } from "./overlay.js";
import { Tour } from "./tour.js";
import { WorkList } from "./worklist.js";
import { PhotoView } from "./photo_view.js";

const POLL = 400; // while the solvers are being prepared [ms]
const SNAP = 14; // reach of snapping clicks on the screen [px]

class App {
  constructor() {
    this.state = null;
    this.selected = null;
    this.snapping = { held: false, on: false };
    this.mover = new Mover(this);
    this.api = new Api({
      onState: (state) => this.show(state),
      onTrouble: (text) => this.layout.tell(text),
      onWorking: (on) => this.layout.showWorking(on),
    });
    const act = (action, select) => this.act(action, select);
    this.panel = new Panel({
      act,
      select: (pair) => this.select(pair),
      suggested: () => this.suggested(),
    });
    this.worklist = new WorkList({ go: (number) => this.goTo(number), tell: (text) => this.layout.tell(text) });
    this.layout = new Layout(
      {
        undo: () => act({ do: "undo" }),
        redo: () => act({ do: "redo" }),
        previous: () => this.go(-1),
        next: () => this.go(1),
        tour: () => this.tour.start(),
        list: () => this.showPhotos(),
        asPhoto: () => this.model.frameAsPhoto(),
        result: (on) => this.showResult(on),
        tool: (tool) => this.choose(tool),
        snap: (on) => this.snap({ on }),
        loupe: (on) => this.magnify(on),
        overlay: (changed) => this.photo.setOverlay(changed),
        photo: { zoom: (factor) => this.photo.zoom(factor), fit: () => this.photo.fit() },
        model: { zoom: (factor) => this.model.zoom(factor), fit: () => this.model.frame() },
      },
      this.panel.root,
    );
    this.photo = new PhotoView(this.layout.photo, {
      onPlace: (uv) => this.place(uv),
      onMark: (action) => this.act(action),
      onSelect: (pair) => this.select(pair),
      onMove: (pair, uv, done) => this.mover.drag(pair, uv, done),
      onTrouble: (text) => this.layout.tell(text),
    });
    this.model = new ModelView(this.layout.model, {
      onPick: (aim) => this.act({ do: "pick", ...aim, pair: this.selected, snap: this.modelReach }),
      onRepick: (pair, aim) => this.repick(pair, aim),
      onSelect: (pair) => this.select(pair),
      onSuggested: () => this.suggested(),
    });
    this.tour = new Tour();
    listen(this);
    window.addEventListener("hashchange", () => this.open());
    window.addEventListener("focus", () => this.api.idle && this.state && this.api.refresh());
  }

  async start() {
    await this.open();
    this.loadModel();
    if (!navigator.webdriver) this.tour.startOnce(); // programs know what to do
  }

  async loadModel() {
    try {
      const { shown, all } = await this.model.load();
      this.photo.shaded = new ShadedOverlay(this.model.group);
      this.photo.invalidate();
      if (shown < all) {
        const counts = `${shown.toLocaleString()} of ${all.toLocaleString()}`;
        this.layout.shown.textContent = `${counts} faces shown, clicks are exact`;
      }
    } catch (error) {
      this.layout.tell(`The model cannot be shown: ${error.message}`);
    }
  }

  /** Show the photo that the address names: #3, counted from 1. */
  open() {
    const number = Math.max(0, (parseInt(location.hash.slice(1), 10) || 1) - 1);
    this.selected = null;
    this.opened = null;
    if (this.model?.result) this.showResult(false);
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
      if (this.model.result) this.showResult(false);
      this.photo.open(image.number, image);
      if (location.hash || image.number) history.replaceState(null, "", `/#${image.number + 1}`);
    }
    if (state.selected !== null) this.selected = state.selected;
    if (!state.pairs.some((pair) => pair.pair === this.selected)) this.selected = null;
    this.layout.show(state);
    this.draw();
    if (state.alignment.status === "preparing") setTimeout(() => this.api.refresh(), POLL);
  }

  draw() {
    this.photo.show(this.state, this.selected);
    this.model.show(this.state, this.selected);
    if (this.model.result) this.showResult(true);
    this.panel.show(this.state, this.selected);
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
  }

  /** Select the pair some places on. */
  step(by) {
    const { pairs } = this.state;
    if (!pairs.length) return;
    const at = pairs.findIndex((pair) => pair.pair === this.selected);
    const next = at < 0 ? (by > 0 ? 0 : pairs.length - 1) : (at + by + pairs.length) % pairs.length;
    this.select(pairs[next].pair);
  }

  deleteSelected() {
    if (this.selected === null) return false;
    return this.act({ do: "delete", pair: this.selected });
  }

  placeMiddle() {
    const uv = this.photo.toPixel(this.photo.middle);
    if (this.photo.marking.active) this.photo.marking.confirm(this.photo.clamp(uv));
    else if (this.photo.contains(uv)) this.place(uv);
  }

  /** Place a point in the photo. */
  place(uv) {
    this.act({ do: "place_uv", uv, pair: this.selected });
  }

  /** Choose what clicks in the photo mark. */
  choose(tool) {
    this.photo.marking.choose(tool);
    this.layout.tools.show(tool);
  }

  /** Give up what is begun, else the tool, else the selection. */
  escape() {
    if (this.photo.marking.cancel()) return;
    if (this.photo.marking.active) this.choose("points");
    else this.select(null);
  }

  /** How far clicks snap on the model [tangent]; 0 if they don't. */
  get modelReach() {
    return this.isSnapping ? this.model.tangent(SNAP) : 0;
  }

  get isSnapping() {
    return this.snapping.held !== this.snapping.on;
  }

  /** Snap while a key is held, or until switched off; the key undoes what is switched on. */
  snap(changed) {
    Object.assign(this.snapping, changed);
    this.layout.showSnapping(this.snapping.on, this.isSnapping);
  }

  /** Magnify about the pointer, or no more. */
  magnify(on = !this.photo.loupe.on) {
    this.photo.loupe.on = this.model.loupe.on = on;
    press(this.layout.loupe, on);
    this.photo.invalidate();
    this.model.stage.invalidate();
  }

  async repick(pair, aim) {
    await this.act({ do: "repick", pair, ...aim, snap: this.modelReach }, pair);
    this.model.drop();
    this.model.stage.invalidate();
  }

  suggested() {
    if (this.state?.suggestion) this.act({ do: "suggested", pair: this.selected });
  }

  /** Show the aligned model before the photo in 3D, or the model to click on again. */
  showResult(on = !this.model.result) {
    const shown = this.model.showResult(on, this.photo.picture);
    press(this.layout.result, shown);
    if (on && !shown) this.layout.tell("There is no stretched model to show yet.");
  }

  /** Go to the photo some places on. */
  go(by) {
    const { image } = this.state ?? { image: { number: 0, count: 1 } };
    const number = image.number + by;
    if (number < 0 || number >= image.count) return false;
    return this.goTo(number);
  }

  goTo(number) {
    location.hash = String(number + 1);
  }

  showPhotos() {
    if (this.state?.image.count > 1) this.worklist.open(this.state.image.number);
  }
}

window.annotator = new App();
window.annotator.start();
