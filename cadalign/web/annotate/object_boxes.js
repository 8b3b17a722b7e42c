// The boxes of all objects of a photo, and their names; those of the others are thin.
const OTHERS = "#f6efdc";
const CURRENT = "#ff5a63";
const WIDTH = 1.2;

/** Draw the boxes of the objects beside the current one, and names where there are several. */
export function drawObjects(view, objects) {
  if (objects.length < 2) return;
  for (const each of objects) {
    if (!each.is_current) view.strokeLines(each.box, OTHERS, WIDTH);
  }
  for (const each of objects) {
    if (each.box.length) drawName(view, each);
  }
}

/** The name below the lowest corner of the box, where there are fewer points than above it. */
function drawName(view, { label, box, is_current: isCurrent }) {
  let low = [0, -Infinity];
  for (let k = 0; k < box.length; k += 2) {
    if (box[k + 1] > low[1]) low = [box[k], box[k + 1]];
  }
  const { context } = view;
  const { x, y } = view.toView(low);
  context.save();
  context.font = `${isCurrent ? 700 : 400} 12px system-ui, sans-serif`;
  context.textAlign = "center";
  const width = context.measureText(label).width + 10;
  context.fillStyle = "rgb(20 22 26 / 78%)";
  context.fillRect(x - width / 2, y + 5, width, 18);
  context.fillStyle = isCurrent ? CURRENT : OTHERS;
  context.fillText(label, x, y + 18);
  context.restore();
}
