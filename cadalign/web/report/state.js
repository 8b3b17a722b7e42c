// The state of the page, kept in the URL's fragment: a link shows the same view.

const DEFAULTS = {
  hide: "", // methods not shown, by key, separated by blanks
  hideruns: "", // runs not shown, by index
  // gallery
  run: "",
  sort: "", // the metric to sort by
  order: "worst", // worst | best | listed
  category: "",
  method: "",
  status: "", // ok | failed
  q: "",
  // the instance that is open
  open: "",
  openrun: "0",
  show: "", // the method whose prediction is drawn
  alt: "", // the alternative drawn in its place
  layers: "gpk", // g: truth, p: prediction, k: keypoints, w: wireframe
};

export class State {
  #values = { ...DEFAULTS };
  #listeners = [];

  constructor() {
    this.#read();
    window.addEventListener("hashchange", () => {
      if (this.fragment() !== location.hash) this.#announce(() => this.#read());
    });
    window.addEventListener("popstate", () => this.#announce(() => this.#read()));
  }

  get(name) {
    return this.#values[name];
  }

  /** A value as an integer, or null. */
  number(name) {
    const value = Number.parseInt(this.#values[name], 10);
    return Number.isNaN(value) ? null : value;
  }

  /** A value that is a list, as the set of its words. */
  words(name) {
    return new Set(this.#values[name].split(" ").filter(Boolean));
  }

  /** Add a word to a list, or remove it. */
  toggle(name, word) {
    const words = this.words(name);
    if (!words.delete(word)) words.add(word);
    this.set({ [name]: [...words].join(" ") });
  }

  /**
   * Change values and call the listeners.
   *
   * @param {object} changes
   * @param {object} options
   * @param {boolean} options.remember - whether the browser's "back" undoes the change
   */
  set(changes, { remember = false } = {}) {
    this.#announce(() => {
      Object.assign(this.#values, changes);
      const url = this.fragment() || location.pathname + location.search;
      history[remember ? "pushState" : "replaceState"](null, "", url);
    });
  }

  /** The fragment of this state with some values changed. */
  fragment(changes = {}) {
    const parameters = new URLSearchParams();
    for (const [name, value] of Object.entries({ ...this.#values, ...changes })) {
      if (value !== DEFAULTS[name]) parameters.set(name, value);
    }
    const text = parameters.toString();
    return text && `#${text}`;
  }

  /** Add a listener, which is called with the names of changed values. */
  listen(action) {
    this.#listeners.push(action);
  }

  #read() {
    const given = new URLSearchParams(location.hash.slice(1));
    for (const name of Object.keys(DEFAULTS)) {
      this.#values[name] = given.get(name) ?? DEFAULTS[name];
    }
  }

  #announce(change) {
    const before = { ...this.#values };
    change();
    const names = Object.keys(DEFAULTS).filter((name) => before[name] !== this.#values[name]);
    if (names.length) for (const action of this.#listeners) action(new Set(names));
  }
}
