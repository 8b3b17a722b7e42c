// The objects of a photo and the photos of an object: a strip over the photo, and a dialog.
import { button, h } from "../common/dom.js";

export class Objects {
  /**
   * @param {object} handlers - act(action, object), go(place), tell(text), focus()
   */
  constructor(handlers) {
    this.handlers = handlers;
    this.open = button("Objects…", () => this.showDialog(), {
      title: "Objects of this photo, and photos of this object (T)", "aria-haspopup": "dialog",
    });
    this.objects = h("div", { class: "chips", role: "group", "aria-label": "Objects of this photo" });
    this.views = h("div", { class: "chips", role: "group", "aria-label": "Photos of this object" });
    this.strip = h("div", { class: "objects" }, this.objects, this.views);
    this.body = h("div", { class: "objects-body" });
    this.dialog = h(
      "dialog",
      { class: "objects-dialog", "aria-labelledby": "objects-title" },
      h("h2", { id: "objects-title" }, "Objects of this photo"),
      this.body,
      h("p", {}, button("Close", () => this.dialog.close())),
    );
    this.dialog.addEventListener("close", () => this.dialog.open || this.dialog.remove()); // open: shown anew
  }

  /** Show a state; says nothing where there is one object in one photo. */
  show(state) {
    this.state = state;
    const { objects, views } = state;
    const isSeveral = objects.length > 1;
    this.objects.replaceChildren(
      ...(isSeveral ? objects.map((each) => this.chip(`${each.label} · ${each.pairs}`, each, "Object")) : []),
    );
    this.views.replaceChildren(
      ...(views.length > 1 ? views.map((each) => this.chip(`${each.name} · ${each.pairs}`, each, "Photo")) : []),
    );
    if (this.dialog.open) this.fill();
  }

  chip(text, place, kind) {
    return button(text, () => this.go(place), {
      "aria-pressed": String(place.is_current),
      title: kind === "Object" ? `Go to ${place.label} (E: the next object)` : `Go to ${place.name} (Y: the next photo of this object)`,
      "aria-label": `${kind} ${text.replace(" · ", ", ")} pairs`,
    });
  }

  go({ number = this.state.image.number, object }) {
    this.handlers.go({ image: number, object });
  }

  /** Go to the object after the current one. */
  nextObject() {
    this.goAfter(this.state?.objects ?? [], "This photo has no other object: T adds one.");
    return true;
  }

  /** Go to the object's photo after the current one. */
  nextView() {
    this.goAfter(this.state?.views ?? [], "This object has no other photo: T adds one.");
    return true;
  }

  goAfter(places, none) {
    if (places.length < 2) {
      this.handlers.tell(none);
      return;
    }
    const at = places.findIndex((each) => each.is_current);
    this.go(places[(at + 1) % places.length]);
  }

  showDialog() {
    if (!this.state) return true;
    this.fill();
    document.body.append(this.dialog);
    this.dialog.showModal();
    return true;
  }

  fill() {
    const { objects, views, deleted } = this.state;
    const focus = this.body.contains(document.activeElement) ? document.activeElement.dataset.key : null;
    const current = objects.find((each) => each.is_current);
    this.body.replaceChildren(
      h("ul", { class: "rows" }, objects.map((each) => this.object(each))),
      this.adding(),
      deleted ? h("p", {}, button(`Bring back: ${deleted}`, () => this.handlers.act({ do: "restore_object" }))) : "",
      h("h2", {}, `Photos of ${current.label}`),
      h(
        "p",
        { class: "soft" },
        "All photos are aligned together: one stretch, and a pose in each photo. Mark the same model points in each.",
      ),
      h("ul", { class: "rows" }, views.map((each) => this.view(each))),
      this.furtherPhotos(),
    );
    if (focus) this.body.querySelector(`[data-key="${focus}"]`)?.focus();
  }

  object(each) {
    const { object, label, name, model, pairs, is_current: isCurrent } = each;
    const rename = h("input", {
      value: name, placeholder: label, maxLength: 60, spellcheck: "false",
      "aria-label": `Name of ${label}`, "data-key": `name ${object}`,
      onchange: () => this.handlers.act({ do: "rename_object", name: rename.value }, object),
    });
    return h(
      "li",
      {},
      button("Go", () => this.leave(each), {
        "aria-label": `Go to ${label}`, "aria-pressed": String(isCurrent), "data-key": `go ${object}`,
      }),
      rename,
      h("span", { class: "soft" }, `${pairs} pairs · ${model}`),
      button("Delete", () => this.handlers.act({ do: "delete_object" }, object), { "aria-label": `Delete ${label}` }),
    );
  }

  adding() {
    const { models, image } = this.state;
    const name = h("input", { placeholder: "name, if you like", maxLength: 60, spellcheck: "false", "aria-label": "Name of the new object", "data-key": "new name" });
    const model = h(
      "select",
      { "aria-label": "Model of the new object", hidden: models.length < 2, "data-key": "new model" },
      models.map((label, number) => h("option", { value: number, selected: number === image.model_number }, label)),
    );
    const add = async (event) => {
      event.preventDefault();
      const state = await this.handlers.act({ do: "add_object", name: name.value, model: Number(model.value) });
      if (!state) return;
      this.dialog.close();
      this.handlers.tell("Mark the new object's points.");
    };
    return h("form", { class: "adding", onsubmit: add }, name, model, h("button", { type: "submit" }, "Add object"));
  }

  view(each) {
    const { number, name, pairs, is_first: isFirst, is_current: isCurrent } = each;
    const remove = () => this.handlers.act({ do: "remove_view" });
    return h(
      "li",
      {},
      button("Go", () => this.leave(each), {
        "aria-label": `Go to ${name}`, "aria-pressed": String(isCurrent), "data-key": `view ${number}`,
      }),
      h("span", { class: "name" }, name),
      h("span", { class: "soft" }, `${pairs} pairs${isFirst ? " · first" : ""}`),
      isCurrent && !isFirst ? button("Take away", remove, { "aria-label": `Take ${name} from the object` }) : null,
    );
  }

  furtherPhotos() {
    const { further_photos: photos } = this.state;
    if (!photos.length) {
      return h("p", { class: "soft" }, "There is no other photo to add: start with a folder of photos, or with --further-photos.");
    }
    const choice = h(
      "select",
      { "aria-label": "Photo to add", "data-key": "new photo" },
      photos.map(({ number, name }) => h("option", { value: number }, name)),
    );
    const add = async (event) => {
      event.preventDefault();
      const state = await this.handlers.act({ do: "add_view", photo: Number(choice.value) });
      if (!state) return;
      this.dialog.close();
      this.handlers.tell("Another photo of the same object: mark the same model points here.");
    };
    return h("form", { class: "adding", onsubmit: add }, choice, h("button", { type: "submit" }, "Add photo"));
  }

  leave(place) {
    this.dialog.close();
    this.go(place);
  }
}
