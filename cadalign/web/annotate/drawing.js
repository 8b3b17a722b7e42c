// How points and lines are drawn, the same in the photo and on the model.

const KINDS = {
  pair: { fill: "#1f5fbf", ring: "#ffffff", radius: 11 },
  selected: { fill: "#0b2e66", ring: "#ffd23f", radius: 13 },
  wrong: { fill: "#b3261e", ring: "#ffffff", radius: 11 },
  free: { fill: "#ffffff", ring: "#3a4048", radius: 5 },
  proposed: { fill: "#ffd23f", ring: "#3a4048", radius: 9 },
  axis: { fill: "#3a4048", ring: "#a4abb5", radius: 9 },
};

/** What a pair looks like. */
export function kindOf(pair, selected) {
  if (pair.pair === selected) return "selected";
  return pair.off === null ? "pair" : "wrong";
}

/** Stroke the path over a dark line, which keeps it visible on any ground. */
export function strokeTwice(context, style, width) {
  for (const [color, more] of [["rgb(0 0 0 / 55%)", 2], [style, 0]]) {
    context.strokeStyle = color;
    context.lineWidth = width + more;
    context.stroke();
  }
}

/** Draw a disk with a label about (x, y). */
export function drawBadge(context, kind, label, x, y) {
  const { fill, ring, radius } = KINDS[kind];
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = fill;
  context.fill();
  strokeTwice(context, ring, 2);
  context.fillStyle = "#ffffff";
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(label, x, y + 0.5);
}
