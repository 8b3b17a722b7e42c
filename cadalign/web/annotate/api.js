// Talks to the server: one request after the other, each answered with the whole state.

const SILENT = "The server does not answer. Everything up to the last action is on disk.";
const LONG = 1000; // without an answer, until the page says that it is waited for [ms]

/** The response of an address; throws an error that says why there is none. */
export async function fetched(address, options = {}) {
  let response;
  try {
    response = await fetch(address, options);
  } catch {
    throw new Error(SILENT);
  }
  if (response.ok) return response;
  throw new Error((await response.text()) || `refused (${response.status})`);
}

export class Api {
  /**
   * @param {object} handlers
   * @param {(state: object) => void} handlers.onState - gets every new state
   * @param {(text: string) => void} handlers.onTrouble - gets what went wrong
   * @param {() => void} handlers.onWorking - hears that an answer takes long
   */
  constructor({ onState, onTrouble, onWorking }) {
    Object.assign(this, { onState, onTrouble, onWorking });
    this.queue = Promise.resolve();
    this.waiting = 0;
    this.image = 0;
  }

  /** Do an action; resolves to the state, or to null if it was refused. */
  act(action) {
    const headers = { "Content-Type": "application/json" };
    return this.enqueue(`act/${this.image}`, { method: "POST", headers, body: JSON.stringify(action) });
  }

  /** Fetch the state anew. */
  refresh() {
    return this.enqueue(`state/${this.image}`);
  }

  /** Go on to another photo. */
  open(image) {
    this.image = image;
    return this.refresh();
  }

  async enqueue(address, options) {
    const { image } = this;
    this.waiting += 1;
    this.slow ??= setTimeout(this.onWorking, LONG);
    const answer = this.queue.then(() => this.send(address, options, image));
    this.queue = answer;
    const state = await answer;
    this.waiting -= 1;
    if (!this.waiting) {
      clearTimeout(this.slow);
      this.slow = null;
    }
    return state;
  }

  async send(address, options, image) {
    let state;
    try {
      state = await (await fetched(address, options)).json();
    } catch (error) {
      this.onTrouble(error.message);
      return null;
    }
    // What still waits after the page went on is of the photo before, and not shown any more.
    if (image === this.image) this.onState(state);
    return state;
  }
}
