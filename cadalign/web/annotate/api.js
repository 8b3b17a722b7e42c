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
    this.place = { image: 0, object: null };
  }

  /**
   * Do an action on the object, or another one of the photo; resolves to the state, or to null if
   * it was refused.
   */
  act(action, object = this.place.object) {
    return this.enqueue(({ image }) => ({
      url: addressOf("act", { image, object }),
      options: {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify(action),
      },
    }));
  }

  /** Fetch the state anew. */
  refresh() {
    return this.enqueue((place) => ({ url: addressOf("state", place), options: {} }));
  }

  /** The revision of what is shown, and whether another browser has changed it; null without one. */
  async claim() {
    try {
      const response = await fetch(addressOf("claim", this.place));
      return response.ok ? await response.json() : null;
    } catch {
      return null; // the next action reports that the server is gone
    }
  }

  /** A library's models, ranked by an object's pairs; null if the server does not answer. */
  async models() {
    try {
      const response = await fetch(addressOf("models", this.place));
      return response.ok ? await response.json() : { note: await reasonOf(response), none: null, models: [] };
    } catch {
      return null;
    }
  }

  /** Go on to another photo, or to an object of one; without a number to its first object. */
  open(image, object = null) {
    this.place = { image, object };
    return this.refresh();
  }

  /** Whether nothing is under way. */
  get idle() {
    return this.waiting === 0;
  }

  enqueue(makeRequest) {
    const { place } = this;
    const request = makeRequest(place);
    this.waiting += 1;
    this.slow ??= setTimeout(() => this.onWorking(true), LONG);
    const answer = this.queue.then(() => this.send(request, place));
    this.queue = answer.catch(() => null);
    return answer.finally(() => {
      this.waiting -= 1;
      if (this.waiting) return;
      clearTimeout(this.slow);
      this.slow = null;
      this.onWorking(false);
    });
  }

  async send({ url, options }, place) {
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
    if (place === this.place) {
      const { number: image, object } = state.image;
      if (place.image === image && place.object === null) place.object = object;
      // What still waits is of the place before: its answers are not shown any more.
      else if (place.image !== image || place.object !== object) this.place = { image, object };
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

/** The address of what concerns an object of a photo. */
export function addressOf(name, { image, object }) {
  return `${name}/${image}${object === null ? "" : `?object=${object}`}`;
}
