"""Real roots of polynomials in an interval, for the compiled kernels."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel

_NEWTON_STEPS = 60
_SEPARATING = 1e-5  # relative accuracy of critical points, which only separate roots
_EXACT = 1e-12


@kernel
def multiply_add(target: FloatArray, first: FloatArray, second: FloatArray, factor: float) -> None:
    """Add ``factor * first * second`` to ``target``; coefficients from the constant upwards."""
    for i in range(first.shape[0]):
        if first[i] != 0.0:
            scaled = factor * first[i]
            for j in range(second.shape[0]):
                target[i + j] += scaled * second[j]


@kernel
def _evaluate(coefficients: FloatArray, degree: int, x: float) -> tuple[float, float]:
    """Value and derivative by Horner's rule."""
    value = coefficients[degree]
    slope = 0.0
    for k in range(degree - 1, -1, -1):
        slope = slope * x + value
        value = value * x + coefficients[k]
    return value, slope


@kernel
def _root_between(
    coefficients: FloatArray,
    degree: int,
    low: float,
    high: float,
    low_value: float,
    high_value: float,
    tolerance: float,
) -> float:
    """The root between two points of opposite sign: Newton's method, kept inside by bisection."""
    share = low_value / (low_value - high_value)
    x = low + (high - low) * min(max(share, 0.1), 0.9)
    for _ in range(_NEWTON_STEPS):
        value, slope = _evaluate(coefficients, degree, x)
        if (value > 0) == (low_value > 0):
            low = x
        else:
            high = x
        following = x - value / slope
        if not low <= following <= high:  # also where the slope is zero
            following = 0.5 * (low + high)
        if abs(following - x) <= tolerance * abs(x) or high - low <= 1e-16:
            return following
        x = following
    return x


@kernel
def real_roots(
    coefficients: FloatArray,
    degree: int,
    start: float,
    end: float,
    touching: float,
    roots: FloatArray,
) -> int:
    """Find the real roots of a polynomial in an interval, and where it nearly touches zero.

    The roots of a derivative separate those of the function above it: starting from the highest
    derivative but one, every stretch between neighbouring critical points holds at most one root.
    ``coefficients`` (degree + 1,) run from the constant upwards, with a degree of at least 2. An
    extremum counts as a root where its value is below the share ``touching`` of the sum of the
    terms' magnitudes: a double root that rounding or noise has lifted off zero. Returns the number
    of ``roots`` (2 * degree,).
    """
    derivative = np.empty(degree + 1)
    critical = np.empty(degree + 2)
    following = np.empty(degree + 2)
    _derive(coefficients, degree, degree - 2, derivative)
    count = _quadratic_roots(derivative, start, end, critical)
    if degree == 2:
        roots[:count] = critical[:count]
        return count
    found = 0
    for order in range(degree - 3, -1, -1):  # of the derivative
        size = degree - order
        _derive(coefficients, degree, order, derivative)
        tolerance = _EXACT if order == 0 else _SEPARATING
        low = start
        low_value, _ = _evaluate(derivative, size, start)
        new = 0
        for k in range(count + 1):
            high = critical[k] if k < count else end
            high_value, _ = _evaluate(derivative, size, high)
            if (low_value > 0) != (high_value > 0):
                following[new] = _root_between(
                    derivative, size, low, high, low_value, high_value, tolerance
                )
                new += 1
            elif order == 0 and k < count:
                magnitude = 0.0
                for i in range(degree, -1, -1):
                    magnitude = magnitude * abs(high) + abs(derivative[i])
                if abs(high_value) < touching * magnitude:
                    roots[found] = high
                    found += 1
            low = high
            low_value = high_value
        critical, following = following, critical
        count = new
    for k in range(count):
        roots[found] = critical[k]
        found += 1
    return found


@kernel
def _derive(coefficients: FloatArray, degree: int, order: int, derivative: FloatArray) -> None:
    """Write a derivative of the given order, over the factorial of the order."""
    factor = 1.0  # k + order over order
    for k in range(degree - order + 1):
        derivative[k] = coefficients[k + order] * factor
        factor = factor * (k + 1 + order) / (k + 1)


@kernel
def _quadratic_roots(coefficients: FloatArray, start: float, end: float, roots: FloatArray) -> int:
    """The real roots of a quadratic inside (start, end), in ascending order."""
    a, b, c = coefficients[2], coefficients[1], coefficients[0]
    discriminant = b * b - 4.0 * a * c
    if not discriminant > 0:
        return 0
    q = -0.5 * (b + (np.sqrt(discriminant) if b >= 0 else -np.sqrt(discriminant)))
    first, second = q / a, c / q
    if first > second:
        first, second = second, first
    count = 0
    if start < first < end:
        roots[count] = first
        count += 1
    if start < second < end:
        roots[count] = second
        count += 1
    return count
