// The dialog in which an instance opens: overlays, 3D view, numbers.
import { onThemeChange } from "../common/colors.js";
import { button, h } from "../common/dom.js";
import {
  alternativeChoice,
  errorTable,
  estimateOf,
  estimateTable,
  warningList,
} from "./details.js";
import { count, number } from "./format.js";
import { unpackMesh, wireOf } from "./mesh.js";
import { LAYERS, layerMark, overlay } from "./overlay.js";
import { keyOf } from "./payload.js";
import { Scene3D, VIEWS } from "./scene.js";
import { radios, refill } from "./choices.js";
import { criteria } from "./selection.js";
import { swatch } from "./swatch.js";

const DRAWN = ["open", "openrun", "show", "alt", "layers"];

export class Viewer {
  /**
   * @param {Report} report
   * @param {State} state
   * @param {object} options
   * @param {function} options.list - returns the instances that the arrow keys step through
   */
  constructor(report, state, { list }) {
    this.report = report;
    this.state = state;
    this.list = list;
    this.meshes = new Map();
    this.build();
    state.listen((names) => DRAWN.some((name) => names.has(name)) && this.sync());
    onThemeChange(() => this.instance && this.draw());
    this.sync();
  }

  build() {
    this.title = h("h2", { id: "viewer-title", tabindex: -1 });
    this.where = h("p", { class: "soft", role: "status" });
    const named = (name) => ({ "aria-label": name });
    this.previous = button("\u2190", () => this.walk(-1), named("previous instance"));
    this.next = button("\u2192", () => this.walk(1), named("next instance"));
    const close = button("\u2715", () => this.dialog.close(), named("close"));
    this.choices = h("div", { class: "choices" });
    this.layers = h(
      "fieldset",
      { class: "layers" },
      h("legend", { class: "visually-hidden" }, "layers"),
      LAYERS.map((layer) => this.layerBox(layer)),
    );
    this.flat = h("div", { class: "flat" });
    this.canvas = h("div", { class: "stage" });
    this.views = h(
      "div",
      { class: "chips", role: "group", "aria-label": "viewpoint" },
      VIEWS.map(([way, words]) => button(words, () => this.scene?.view(way), { class: "chip" })),
    );
    this.solid = h("figure", { class: "solid" }, this.canvas, h("figcaption", {}, this.views));
    this.numbers = h("div", { class: "details" });
    this.dialog = h(
      "dialog",
      {
        class: "viewer",
        "aria-labelledby": "viewer-title",
        onclose: () => this.left(),
        onclick: (event) => event.target === this.dialog && this.dialog.close(),
        onkeydown: (event) => this.key(event),
      },
      h(
        "div",
        { class: "sheet" },
        h(
          "header",
          {},
          h("div", { class: "titles" }, this.title, this.where),
          h("nav", {}, this.previous, this.next, close),
        ),
        h("div", { class: "tools" }, this.choices, this.layers),
        h("div", { class: "views" }, this.flat, this.solid),
        this.numbers,
      ),
    );
    document.body.append(this.dialog);
  }

  layerBox({ key, label, kind }) {
    const onchange = () => this.toggleLayer(key);
    const box = h("input", { type: "checkbox", value: key, onchange });
    return h("label", { class: "option" }, box, layerMark(kind), label);
  }

  toggleLayer(key) {
    const shown = this.state.get("layers");
    const wanted = LAYERS.filter((layer) => shown.includes(layer.key) !== (layer.key === key));
    this.state.set({ layers: wanted.map((layer) => layer.key).join("") });
  }

  open(instance) {
    this.state.set(
      { open: keyOf(instance), openrun: String(instance.run), alt: "" },
      { remember: true },
    );
  }

  /** Open or close the dialog according to the state. */
  sync() {
    const key = this.state.get("open");
    const instance = key ? this.report.find(this.state.get("openrun"), key) : null;
    if (!instance) {
      if (this.dialog.open) this.dialog.close();
      return;
    }
    const fresh = this.instance !== instance;
    this.instance = instance;
    if (!this.dialog.open) {
      this.dialog.showModal();
      this.title.focus();
    }
    this.draw({ fresh });
  }

  left() {
    if (this.dialog.open) return; // another instance was opened meanwhile
    this.instance = null;
    if (this.state.get("open")) this.state.set({ open: "", openrun: "0", alt: "" });
  }

  walk(step) {
    const list = this.list();
    const at = list.indexOf(this.instance);
    const to = list[at + step];
    if (to && at >= 0) this.state.set({ open: keyOf(to), openrun: String(to.run), alt: "" });
  }

  key(event) {
    if (event.target.closest("input, select, textarea, [tabindex='0']")) return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    this.walk(step);
  }

  /** Methods with a result for the instance, and the method whose prediction is drawn. */
  shown() {
    const tried = this.report.fitted.filter(({ key }) => this.instance.rows.has(key));
    const { chosen, shown } = criteria(this.report, this.state);
    const wanted = [this.state.get("show"), chosen?.key, shown[0]?.key];
    const method =
      wanted.map((key) => tried.find((other) => other.key === key)).find(Boolean) ?? tried[0];
    return { tried, method };
  }

  draw({ fresh = false } = {}) {
    const { instance } = this;
    const list = this.list();
    const at = list.indexOf(instance);
    const { tried, method } = this.shown();
    this.title.textContent = instance.model;
    this.where.textContent = this.words(instance, at, list.length);
    this.previous.disabled = at <= 0;
    this.next.disabled = at < 0 || at >= list.length - 1;
    refill(this.choices, [this.methodChoice(tried, method), this.runChoice(instance)]);
    for (const box of this.layers.querySelectorAll("input"))
      box.checked = this.state.get("layers").includes(box.value);

    const exhibit = this.report.exhibit(instance);
    const mesh = this.mesh(exhibit?.mesh);
    this.flat.replaceChildren(this.flatFigure(instance, exhibit, mesh, method));
    this.drawSolid(exhibit, mesh, method, fresh);
    this.drawNumbers(exhibit, method);
  }

  words(instance, at, all) {
    const parts = [
      instance.category,
      instance.view !== null && `view ${number(instance.view)}`,
      instance.keypoints !== null && `${instance.keypoints} keypoints`,
      this.report.runs.length > 1 && this.report.runs[instance.run]?.name,
      at >= 0 && `${count(at + 1)} of ${count(all)}`,
    ];
    return parts.filter(Boolean).join(" \u00b7 ");
  }

  methodChoice(tried, method) {
    if (tried.length < 2) return null;
    return radios("prediction of", tried, {
      checked: (one) => one === method,
      words: (one) => [swatch(this.report, one), one.key],
      choose: (one) => this.state.set({ show: one.key, alt: "" }),
    });
  }

  runChoice(instance) {
    const there = this.report.siblings.get(instance.id) ?? [];
    if (there.length < 2) return null;
    const choose = ({ run }) => this.state.set({ openrun: String(run), alt: "" });
    return radios("run", there, {
      checked: (one) => one === instance,
      words: (one) => [this.report.runs[one.run].name],
      choose,
    });
  }

  /** The unpacked model, cached: several instances share it. */
  mesh(key) {
    if (key == null) return null;
    if (!this.meshes.has(key)) {
      const mesh = unpackMesh(this.report.meshes[key]);
      this.meshes.set(key, { ...mesh, wire: wireOf(mesh) }); // points and edges for lines
    }
    return this.meshes.get(key);
  }

  /** The pose to draw: the estimate's, or the chosen alternative. */
  pose(exhibit, method) {
    const estimate = estimateOf(exhibit, method?.key);
    if (!estimate?.rotation) return null;
    return estimate.alternatives?.[this.state.number("alt") - 1] ?? estimate;
  }

  flatFigure(instance, exhibit, mesh, method) {
    const several = this.report.runs.length > 1;
    const run = several && this.report.runs[instance.run].name;
    const failed = method && this.report.failed(instance, method.key);
    const isWarped = mesh && this.pose(exhibit, method)?.warp;
    const caption = [
      run,
      method?.key,
      failed && "failed: no prediction to draw",
      isWarped && "the model is warped to the estimated shape",
    ]
      .filter(Boolean)
      .join(" \u00b7 ");
    if (!exhibit) {
      const thumb = this.report.thumb(instance);
      return h(
        "figure",
        {},
        thumb
          ? h("img", { class: "overlay pictured", src: thumb, alt: `overlay of ${instance.model}` })
          : h("p", { class: "empty" }, "The run kept no picture and no poses of this instance."),
        h("figcaption", {}, caption),
      );
    }
    const picture = this.report.picture(exhibit);
    const drawing = overlay(exhibit, {
      picture,
      estimate: this.pose(exhibit, method),
      wire: mesh?.wire,
      layers: new Set(this.state.get("layers")),
      label: `overlay of ${instance.model}: ${caption}`,
    });
    return h(
      "figure",
      {},
      drawing,
      h("figcaption", {}, caption, !picture && " \u00b7 the run kept no picture"),
    );
  }

  drawSolid(exhibit, mesh, method, fresh) {
    this.solid.hidden = this.layers.hidden = !exhibit;
    if (!exhibit) return;
    const lacks = {
      g: !exhibit.gt,
      k: !exhibit.points_2d?.length,
      w: mesh?.wire.layer !== "w",
    };
    for (const box of this.layers.querySelectorAll("input"))
      box.parentElement.hidden = lacks[box.value] ?? false;
    try {
      this.scene ??= new Scene3D(this.canvas);
    } catch {
      this.views.hidden = true;
      this.canvas.replaceChildren(
        h("p", { class: "empty" }, "The 3D view needs WebGL, which this browser does not offer."),
      );
      return;
    }
    this.scene.show(exhibit, {
      estimate: this.pose(exhibit, method),
      mesh,
      layers: new Set(this.state.get("layers")),
      stay: !fresh,
    });
  }

  drawNumbers(exhibit, method) {
    const estimate = estimateOf(exhibit, method?.key);
    const parts = [errorTable(this.report, this.instance, exhibit)];
    if (estimate?.rotation) {
      const choose = (index) => this.state.set({ alt: index ? String(index) : "" });
      parts.push(
        warningList(estimate),
        alternativeChoice(estimate, this.state.number("alt") ?? 0, choose),
        estimateTable(exhibit, estimate, method.key),
      );
    }
    refill(this.numbers, parts);
  }
}
