// Numbers and words as the page shows them.

const MINUS = "\u2212";
const NONE = "\u2013";

const signed = (text) => text.replace(/^-/, MINUS);

/** A number with so many decimals; without a count, three significant digits. */
export function number(value, digits) {
  if (value == null || !Number.isFinite(value)) return NONE;
  if (Number.isInteger(value) && digits == null) return signed(value.toLocaleString("en-US"));
  if (digits != null) {
    const fixed = value.toFixed(digits);
    // A value that rounds to nothing still is something.
    if (value !== 0 && Number(fixed) === 0) return signed(value.toPrecision(1));
    return signed(fixed);
  }
  const plain = Math.abs(value) >= 1e-4 && Math.abs(value) < 1e6;
  if (!plain && value !== 0) return signed(value.toExponential(1));
  return signed(Number(value.toPrecision(3)).toString());
}

/** A number with its unit. */
export function quantity(value, { digits, unit } = {}) {
  const text = number(value, digits);
  if (!unit || text === NONE) return text;
  return unit === "%" || unit === "\u00b0" ? `${text}${unit}` : `${text}\u202f${unit}`;
}

export const count = (value) => value.toLocaleString("en-US");

export const plural = (value, one, many = `${one}s`) =>
  `${count(value)} ${value === 1 ? one : many}`;

/** A metric's name with its unit, as an axis or a column has it. */
export const named = ({ label, unit }) => (unit ? `${label} [${unit}]` : label);
