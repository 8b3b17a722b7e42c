// What the plots show, from plain arrays of numbers.

const ascending = (a, b) => a - b;

/** A quantile of sorted values, between neighbours linearly. */
export function quantile(sorted, share) {
  if (!sorted.length) return null;
  const place = (sorted.length - 1) * share;
  const low = Math.floor(place);
  const high = Math.min(low + 1, sorted.length - 1);
  return sorted[low] + (sorted[high] - sorted[low]) * (place - low);
}

export const median = (values) => quantile([...values].sort(ascending), 0.5);

/**
 * The share [%] of all tries that reach a value: with at most it, or with at least it.
 *
 * @param {number[]} values - of the tries that gave one
 * @param {number} tries - with those that gave none
 * @param {object} options
 * @param {number} options.limit - where the curve ends
 * @param {boolean} options.high - whether large values are good
 * @param {number} options.points - how many to draw it with
 */
export function cumulative(values, tries, { limit, high = false, points = 240 }) {
  const sorted = Float64Array.from(values).sort();
  const x = [];
  const y = [];
  let below = 0;
  for (let i = 0; i <= points; i++) {
    const at = (limit * i) / points;
    while (below < sorted.length && (high ? sorted[below] < at : sorted[below] <= at)) below++;
    x.push(at);
    y.push((100 * (high ? sorted.length - below : below)) / tries);
  }
  return { x, y };
}

/**
 * Medians with quartiles of y over bins of x.
 *
 * Few different values of x are bins of their own (to be told apart in a plot, whole numbers are);
 * many are put into bins of equally many points.
 *
 * @param {number[]} xs
 * @param {number[]} ys
 * @param {number} most - how many bins at most
 * @returns {{x: number, low: number, middle: number, high: number, n: number}[]}
 */
export function binned(xs, ys, most = 10) {
  const order = xs.map((_, index) => index).sort((a, b) => xs[a] - xs[b]);
  const distinct = new Set(xs).size;
  const bins = [];
  if (distinct <= most + 6) {
    for (const index of order) {
      const last = bins.at(-1);
      if (last && xs[last[0]] === xs[index]) last.push(index);
      else bins.push([index]);
    }
  } else {
    const each = Math.max(order.length / most, 5);
    for (let start = 0; start < order.length - each / 2; start += each) {
      const end = start + 1.5 * each > order.length ? order.length : start + each;
      bins.push(order.slice(Math.round(start), Math.round(end)));
    }
  }
  return bins.map((bin) => {
    const sorted = bin.map((index) => ys[index]).sort(ascending);
    return {
      x: median(bin.map((index) => xs[index])),
      low: quantile(sorted, 0.25),
      middle: quantile(sorted, 0.5),
      high: quantile(sorted, 0.75),
      n: bin.length,
    };
  });
}

/** Numbers in [0, 1) that follow from a seed (mulberry32). */
export function randomStream(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let word = Math.imul(state ^ (state >>> 15), 1 | state);
    word = (word + Math.imul(word ^ (word >>> 7), 61 | word)) ^ word;
    return ((word ^ (word >>> 14)) >>> 0) / 2 ** 32;
  };
}
