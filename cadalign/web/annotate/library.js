// The models of a library, ranked by the pairs marked so far; one click goes on with another.
import { button, h } from "../common/dom.js";

const BUSY = "Ranking… (the first time after an installation takes a minute)";

export class ModelLibrary {
  /** @param {object} handlers - act(action), rank(): resolves to a ranking or null */
  constructor(handlers) {
    this.handlers = handlers;
    this.models = [];
    this.note = h("p", { class: "soft note", role: "status" });
    this.grid = h("ol", { class: "thumbs models" });
    this.none = button("None of these", () => this.dialog.close(), { title: "0: go on with the model as it is" });
    this.dialog = h(
      "dialog",
      { class: "worklist library", "aria-labelledby": "library-title" },
      h("h2", { id: "library-title" }, "Models of the library"),
      this.note,
      h("p", {}, this.none, " ", button("Close", () => this.dialog.close())),
      this.grid,
    );
    this.dialog.addEventListener("keydown", (event) => this.key(event));
    this.dialog.addEventListener("close", () => this.dialog.open || this.dialog.remove()); // open: shown anew
  }

  async open() {
    if (this.dialog.open) return;
    this.show({ note: BUSY, none: null, models: [] });
    document.body.append(this.dialog);
    this.dialog.showModal();
    const ranking = await this.handlers.rank();
    this.show(ranking ?? { note: "The server does not answer.", none: null, models: [] });
  }

  show({ note, none, models }) {
    this.models = models;
    this.note.textContent = note;
    this.none.textContent = none === null ? "None of these" : `None of these: ${none}`;
    this.grid.replaceChildren(...models.map((model, rank) => this.card(model, rank)));
  }

  card(model, rank) {
    const { number, category, model: id, probability, rms, shared, marked, has_mesh: hasMesh, current } = model;
    const quality = `${probability} · ${rms.toFixed(1)} px · ${shared} of ${marked}`;
    const made = button("", () => this.choose(model), {
      disabled: !hasMesh, title: rank < 9 ? `${id} (${rank + 1})` : id,
    });
    made.append(
      hasMesh ? h("img", { src: `library/${number}.jpg`, alt: "", width: 120, height: 90 }) : h("span", { class: "picture" }, "no mesh"),
      h("span", { class: "name" }, `${rank + 1}. ${id}`),
      h("span", { class: "state" }, `${category} · ${quality}`),
    );
    return h("li", { "aria-current": current ? "true" : null }, made);
  }

  choose({ category, model, current }) {
    this.dialog.close();
    if (!current) this.handlers.act({ do: "model", category, model });
  }

  /** The model's place in the list, or 0 for none of them. */
  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const model = this.models[Number(event.key) - 1];
    if (event.key === "0") this.dialog.close();
    else if (/^[1-9]$/.test(event.key) && model?.has_mesh) this.choose(model);
    else return;
    event.preventDefault();
  }
}
