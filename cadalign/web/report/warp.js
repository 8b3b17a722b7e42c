// Warp of a model to an estimated shape; see cadalign/shapes/warp.py, here for equal boxes.

// Lengths relative to the diagonal of model and keypoints.
const ROUNDING = 0.02;
const MARGIN = 0.25;
const COINCIDENT = 1e-6;

/**
 * A function that warps points [x, y, z] and moves given places to targets.
 *
 * @param {object} warp
 * @param {number[][]} warp.from - places on the model
 * @param {number[][]} warp.to - their targets
 * @param {number[][]} bounds - the model's lowest and highest coordinates
 */
export function warpOf({ from, to }, bounds) {
  if (!from.length) return (points) => points;
  const all = [...bounds, ...from];
  const low = [0, 1, 2].map((k) => Math.min(...all.map((point) => point[k])));
  const high = [0, 1, 2].map((k) => Math.max(...all.map((point) => point[k])));
  const diagonal = distance(low, high) || 1;
  const { places, moves } = merged(from, to, COINCIDENT * diagonal);
  const epsilon = 1 / rounding(places, diagonal);
  for (let corner = 0; corner < 8; corner++) {
    const end = (k) => ((corner >> k) & 1 ? high[k] + MARGIN * diagonal : low[k] - MARGIN * diagonal);
    places.push([0, 1, 2].map(end));
    moves.push([0, 0, 0]);
  }
  const kernel = (a, b) => -Math.hypot(1, epsilon * distance(a, b));
  const rows = places.map((place) => [...places.map((other) => kernel(place, other)), 1]);
  rows.push([...places.map(() => 1), 0]);
  const weights = solve(rows, [...moves, [0, 0, 0]]);
  const shift = weights[places.length];
  return (points) =>
    points.map((point) => {
      const moved = [0, 1, 2].map((k) => point[k] + shift[k]);
      places.forEach((place, i) => {
        const near = kernel(point, place);
        for (let k = 0; k < 3; k++) moved[k] += near * weights[i][k];
      });
      return moved;
    });
}

const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

/** Places and their moves; coincident places are merged, with the mean move. */
function merged(from, to, tolerance) {
  const groups = [];
  from.forEach((place, i) => {
    const group = groups.find((one) => distance(one.place, place) <= tolerance);
    if (group) group.targets.push(to[i]);
    else groups.push({ place, targets: [to[i]] });
  });
  const mean = (targets, k) => targets.reduce((sum, one) => sum + one[k], 0) / targets.length;
  return {
    places: groups.map(({ place }) => place),
    moves: groups.map(({ place, targets }) => [0, 1, 2].map((k) => mean(targets, k) - place[k])),
  };
}

/** Radius of the kernel's rounded tip: smaller if places are close together. */
function rounding(places, diagonal) {
  let least = places.length > 1 ? Infinity : diagonal;
  for (let i = 0; i < places.length; i++)
    for (let j = 0; j < i; j++) least = Math.min(least, distance(places[i], places[j]));
  return Math.min(ROUNDING * diagonal, least);
}

/** Solve linear equations with several right sides by Gaussian elimination. */
function solve(matrix, sides) {
  const rows = matrix.map((row, i) => [...row, ...sides[i]]);
  const n = rows.length;
  for (let k = 0; k < n; k++) {
    let best = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(rows[i][k]) > Math.abs(rows[best][k])) best = i;
    [rows[k], rows[best]] = [rows[best], rows[k]];
    for (let i = 0; i < n; i++) {
      if (i === k) continue;
      const factor = rows[i][k] / rows[k][k];
      if (factor) for (let j = k; j < rows[k].length; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  return rows.map((row, i) => row.slice(n).map((value) => value / row[i]));
}
