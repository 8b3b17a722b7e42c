// Talks to the server: one request after the other, each answered with the whole state.

const SILENT = "The server does not answer. Everything up to the last “Saved” is on disk.";
const LONG = 1000; // without an answer, until the page says that it is waited for [ms]

export class Api {
  /**
   * @param {object} handlers
   * @param {(state: object) => void} handlers.onState - gets every new state
   * @param {(text: string) => void} handlers.onTrouble - gets what went wrong; "" when all is well
   * @param {(on: boolean) => void} handlers.onWorking - hears that an answer takes long, and its end
   */
  constructor({ onState, onTrouble, onWorking }) {
    this.onState = onState;
    this.onTrouble = onTrouble;
    this.onWorking = onWorking;
    this.queue = Promise.resolve();
    this.waiting = 0;
    this.image = 0;
  }

  /** Do an action; resolves to the state, or to null if it was refused. */
  act(action) {
    return this.enqueue({
      url: `act/${this.image}`,
      options: {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify(action),
      },
    });
  }

  /** Fetch the state anew. */
  refresh() {
    return this.enqueue({ url: `state/${this.image}`, options: {} });
  }

  /** Go on to another photo. */
  open(image) {
    this.image = image;
    return this.refresh();
  }

  /** Whether nothing is under way. */
  get idle() {
    return this.waiting === 0;
  }

  enqueue(request) {
    const { image } = this;
    this.waiting += 1;
    this.slow ??= setTimeout(() => this.onWorking(true), LONG);
    const answer = this.queue.then(() => this.send(request, image));
    this.queue = answer.catch(() => null);
    return answer.finally(() => {
      this.waiting -= 1;
      if (this.waiting) return;
      clearTimeout(this.slow);
      this.slow = null;
      this.onWorking(false);
    });
  }

  async send({ url, options }, image) {
    let response;
    try {
      response = await fetch(url, options);
    } catch {
      this.onTrouble(SILENT);
      return null;
    }
    if (!response.ok) {
      this.onTrouble(await reasonOf(response));
      return null;
    }
    const state = await response.json();
    this.onTrouble("");
    // What still waits after the page went on is of the photo before, and not shown any more.
    if (image === this.image) {
      this.image = state.image.number;
      this.onState(state);
    }
    return state;
  }
}

/** Why the server refused a request. */
async function reasonOf(response) {
  const text = await response.text();
  try {
    return JSON.parse(text).error;
  } catch {
    return text || `refused (${response.status})`;
  }
}

/** Why an address has no file; null if it has one. */
export async function failureOf(address) {
  try {
    const response = await fetch(address);
    return response.ok ? null : await reasonOf(response);
  } catch {
    return SILENT;
  }
}
