// Talks to the server: one request after the other, each answered with the whole state.

export class Api {
  /**
   * @param {object} handlers
   * @param {(state: object) => void} handlers.onState - gets every new state
   * @param {(text: string) => void} handlers.onTrouble - gets what went wrong; "" when all is well
   */
  constructor({ onState, onTrouble }) {
    this.onState = onState;
    this.onTrouble = onTrouble;
    this.queue = Promise.resolve();
    this.waiting = 0;
    this.image = 0;
  }

  /** Do an action on the photo; resolves to the state, or to null if it was refused. */
  act(action) {
    return this.enqueue((image) => ({
      url: `act/${image}`,
      options: {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify(action),
      },
    }));
  }

  /** Fetch the state anew. */
  refresh() {
    return this.enqueue((image) => ({ url: `state/${image}`, options: {} }));
  }

  /** What could be added to a photo's pairs, ranked; null if it cannot be told. Nothing waits for it. */
  async advice(image) {
    try {
      const response = await fetch(`advice/${image}`);
      return response.ok ? await response.json() : null;
    } catch {
      return null; // the next action tells that the server is gone
    }
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

  enqueue(makeRequest) {
    const image = this.image;
    this.waiting += 1;
    const answer = this.queue.then(() => this.send(makeRequest(image), image));
    this.queue = answer.catch(() => null);
    return answer.finally(() => {
      this.waiting -= 1;
    });
  }

  async send({ url, options }, image) {
    let response;
    try {
      response = await fetch(url, options);
    } catch {
      this.onTrouble("The server does not answer. Everything up to the last “Saved” is on disk.");
      return null;
    }
    if (!response.ok) {
      this.onTrouble(await this.reason(response));
      return null;
    }
    const state = await response.json();
    this.onTrouble("");
    if (image === this.image) this.onState(state);
    return state;
  }

  async reason(response) {
    const text = await response.text();
    try {
      return JSON.parse(text).error;
    } catch {
      return text || `refused (${response.status})`;
    }
  }
}
