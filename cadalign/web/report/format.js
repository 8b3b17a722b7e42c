// Formats of numbers and names.

const MINUS = "\u2212";
const NONE = "\u2013";

const signed = (text) => text.replace(/^-/, MINUS);

/** A number with a number of decimals, by default with three significant digits. */
export function number(value, digits) {
  if (value == null || !Number.isFinite(value)) return NONE;
  if (Number.isInteger(value) && digits == null) return signed(value.toLocaleString("en-US"));
  if (digits != null) {
    const fixed = value.toFixed(digits);
    // A small value that would be rounded to 0 keeps one digit.
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

/** A metric's name with its unit. */
export const named = ({ label, unit }) => (unit ? `${label} [${unit}]` : label);
