// Moves points of the photo, dragged or nudged; what belongs together is undone together.

const PAUSE = 800; // nudges that follow each other faster are undone together [ms]

export class Mover {
  constructor(app) {
    this.app = app;
    this.gesture = Math.floor(Math.random() * 2 ** 40); // another than in other tabs
  }

  /** Follow a point that is dragged: one request under way at a time, the last place wins. */
  async drag(pair, uv, done) {
    if (!this.dragging) this.gesture += 1;
    this.dragging = !done;
    this.app.selected = pair;
    this.draggedTo = { pair, uv, done };
    if (this.following) return;
    this.following = true;
    while (this.draggedTo) {
      const { done: last, ...move } = this.draggedTo;
      this.draggedTo = null;
      await this.app.api.act({ do: "move", gesture: this.gesture, ...move });
      if (last) this.app.photo.dragged = null;
      this.app.photo.invalidate();
    }
    this.following = false;
  }

  nudge(x, y) {
    const pair = this.app.state?.pairs.find((one) => one.pair === this.app.selected);
    if (!pair?.uv) return false;
    const now = performance.now();
    if (!(now - this.nudgedAt < PAUSE) || this.nudged?.pair !== pair.pair) this.gesture += 1;
    this.nudgedAt = now;
    // Answers to earlier nudges may still be on their way: go on from where the last one led.
    const under = this.nudged?.pair === pair.pair && this.nudged.waiting > 0;
    const from = under ? this.nudged.uv : pair.uv;
    this.nudged = {
      pair: pair.pair,
      uv: this.app.photo.clamp([from[0] + x, from[1] + y]),
      waiting: (under ? this.nudged.waiting : 0) + 1,
    };
    const { uv } = this.nudged;
    this.app.photo.dragged = { pair: pair.pair, uv };
    this.app.photo.invalidate();
    this.app.act({ do: "move", pair: pair.pair, uv, gesture: this.gesture }).then(() => {
      if (this.nudged?.pair !== pair.pair) return;
      this.nudged.waiting -= 1;
      if (this.nudged.waiting === 0) this.app.photo.dragged = null;
      this.app.photo.invalidate();
    });
    return true;
  }
}
