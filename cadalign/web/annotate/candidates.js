// Alignments that a mask alone allows: small pictures to choose from.
import { button, h, svg } from "../common/dom.js";

const MARGIN = 0.12; // about an outline, of its longer side

export class Candidates {
  /** @param {object} handlers - act(action) */
  constructor({ act }) {
    this.act = act;
    this.root = h("div", { class: "candidates" });
  }

  show({ by_mask: { chosen, candidates, text }, image }) {
    this.root.hidden = !chosen && !candidates.length;
    if (this.root.hidden) return;
    this.root.replaceChildren(
      ...(chosen
        ? [
            h("p", {}, "Begun at the alignment that you chose."),
            button("Choose again", () => this.act({ do: "begin_at", candidate: null })),
          ]
        : [
            h("p", {}, text),
            h("div", { class: "strip" }, candidates.map((each, place) => this.picture(each, place, image))),
          ]),
    );
  }

  picture({ number, lines, likelihood }, place, image) {
    const share = place ? `${Math.max(1, Math.round(100 * likelihood))} % as likely` : "likeliest";
    return h(
      "button",
      {
        type: "button",
        "aria-label": `Alignment ${place + 1}, ${share}`,
        onclick: () => this.act({ do: "begin_at", candidate: number }),
      },
      svg(
        "svg",
        { viewBox: boxAbout(lines), "aria-hidden": "true" },
        svg("image", { href: `photo/${image.number}`, width: image.width, height: image.height }),
        svg("path", { d: pathOf(lines) }),
      ),
      h("span", {}, share),
    );
  }
}

function pathOf(lines) {
  const parts = [];
  for (let k = 0; k < lines.length; k += 4) {
    parts.push(`M${lines[k]} ${lines[k + 1]}L${lines[k + 2]} ${lines[k + 3]}`);
  }
  return parts.join("");
}

/** The square about lines, as a view box. */
function boxAbout(lines) {
  const us = lines.filter((_, k) => k % 2 === 0);
  const vs = lines.filter((_, k) => k % 2 === 1);
  const [left, right] = [Math.min(...us), Math.max(...us)];
  const [top, bottom] = [Math.min(...vs), Math.max(...vs)];
  const side = (1 + 2 * MARGIN) * Math.max(right - left, bottom - top, 1);
  return `${(left + right - side) / 2} ${(top + bottom - side) / 2} ${side} ${side}`;
}
