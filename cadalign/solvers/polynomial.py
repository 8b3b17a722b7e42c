"""Real roots of polynomials near zero, for the compiled kernels."""

from __future__ import annotations

from cadalign.arrays import FloatArray
from cadalign.compile import inline, kernel

_HALVINGS = 40
_REFRESH_PERIOD = 3  # halvings after which the first interval's coefficients are recomputed
_LEAST_RELATIVE_WIDTH = 1e-3  # below it, two sign changes are a pair of roots or none
_NEWTON_STEPS = 60
_ROOT_TOLERANCE = 1e-7  # last relative Newton step; the remaining error is about its square

ROOTS_ROWS = _HALVINGS + 3
"""Rows of memory for `real_roots`: coefficients, roots, Bernstein coefficients of intervals."""


@inline
def real_roots(memory: FloatArray, first: int, degree: int, reach: float, touching: float) -> int:
    """Write the real roots of a polynomial in (-reach, reach); returns their number.

    Intervals are halved until Descartes' rule of signs on their Bernstein coefficients allows one
    root (Lane, Riesenfeld, "Bounds on a polynomial", 1981). An extremum also counts as a root if
    its value is below ``touching`` times the sum of the terms' magnitudes: a double root that
    rounding or noise has moved off zero.

    Row ``first`` of ``memory`` holds the coefficients, constant first, of degree 2 or more. The
    next row receives the roots; the other `ROOTS_ROWS` - 2 rows are scratch space. All data is in
    one array because counting references to several takes as long as the search.
    """
    found = 0
    for end in (-reach, reach):
        found = _roots_up_to(memory, first, degree, end, touching, found)
    return found


@inline
def _roots_up_to(
    memory: FloatArray, first: int, degree: int, end: float, touching: float, found: int
) -> int:
    """Append the roots between zero and ``end``, of either sign; returns the new number."""
    top = first + 2
    _to_bernstein(memory, first, degree, end, top)
    # Depth-first from zero outwards: interval ``index`` of 2^depth is in row ``top``; the rows
    # before it hold the outer halves that are still to be visited.
    depth = index = 0
    width = end
    while True:
        near = index * width
        far = near + width
        if index == 0 and depth > 0 and depth % _REFRESH_PERIOD == 0:
            _to_bernstein(memory, first, degree, far, top)
        changes = 0
        for k in range(degree):
            changes += (memory[top, k] > 0) != (memory[top, k + 1] > 0)
        if changes > 1 and depth < _HALVINGS and abs(width) > _LEAST_RELATIVE_WIDTH * abs(near):
            _halve(memory, top, degree)
            depth += 1
            index *= 2
            top += 1
            width *= 0.5
            continue
        if changes > 0 and found < 2 * degree - 1:
            low, high = min(near, far), max(near, far)
            if changes % 2 == 1:
                memory[first + 1, found] = _root_between(memory, first, degree, low, high)
                found += 1
            else:
                found = _add_pair(memory, first, degree, low, high, touching, top, found)
        while index % 2 == 1:  # an outer half completes its parent
            depth -= 1
            index //= 2
            width *= 2.0
        if depth == 0:
            return found
        index += 1
        top -= 1


@inline
def _evaluate(memory: FloatArray, row: int, degree: int, x: float) -> tuple[float, float]:
    """Value and derivative by Horner's rule."""
    value = memory[row, degree]
    slope = 0.0
    for k in range(degree - 1, -1, -1):
        slope = slope * x + value
        value = value * x + memory[row, k]
    return value, slope


@kernel
def _root_between(memory: FloatArray, row: int, degree: int, low: float, high: float) -> float:
    """Find the root between two points of opposite sign by Newton's method with bisection."""
    low_value, _ = _evaluate(memory, row, degree, low)
    high_value, _ = _evaluate(memory, row, degree, high)
    share = low_value / (low_value - high_value)
    x = low + (high - low) * min(max(share, 0.1), 0.9)
    for _ in range(_NEWTON_STEPS):
        value, slope = _evaluate(memory, row, degree, x)
        if (value > 0) == (low_value > 0):
            low = x
        else:
            high = x
        following = x - value / slope
        if not low <= following <= high:  # also if the slope is zero
            following = 0.5 * (low + high)
        if abs(following - x) <= _ROOT_TOLERANCE * abs(x) or high - low <= 1e-16:
            return following
        x = following
    return x


@inline
def _to_bernstein(memory: FloatArray, first: int, degree: int, end: float, top: int) -> None:
    """Write the Bernstein coefficients on the interval from zero to ``end`` into row ``top``."""
    memory[top, 0] = memory[first, 0]
    scale = 1.0
    for k in range(1, degree + 1):  # coefficients in x / end, divided by binomials
        scale *= end * k / (degree - k + 1)
        memory[top, k] = scale * memory[first, k]
    for i in range(degree):
        for k in range(degree, i, -1):
            memory[top, k] += memory[top, k - 1]


@inline
def _halve(memory: FloatArray, top: int, degree: int) -> None:
    """Halve by de Casteljau's algorithm: row ``top`` keeps the outer half, the next the inner."""
    for i in range(degree + 1):
        memory[top + 1, i] = memory[top, 0]
        for k in range(degree - i):
            memory[top, k] = 0.5 * (memory[top, k] + memory[top, k + 1])


@kernel
def _add_pair(
    memory: FloatArray,
    first: int,
    degree: int,
    low: float,
    high: float,
    touching: float,
    derivative: int,
    found: int,
) -> int:
    """Append two roots, or an extremum near zero, of a narrow interval; returns the new number."""
    low_value, low_slope = _evaluate(memory, first, degree, low)
    _, high_slope = _evaluate(memory, first, degree, high)
    if (low_slope > 0) == (high_slope > 0):
        return found
    for k in range(degree):
        memory[derivative, k] = (k + 1) * memory[first, k + 1]
    x = _root_between(memory, derivative, degree - 1, low, high)
    value, _ = _evaluate(memory, first, degree, x)
    if (value > 0) != (low_value > 0):
        memory[first + 1, found] = _root_between(memory, first, degree, low, x)
        memory[first + 1, found + 1] = _root_between(memory, first, degree, x, high)
        return found + 2
    magnitude = 0.0
    for k in range(degree, -1, -1):
        magnitude = magnitude * abs(x) + abs(memory[first, k])
    memory[first + 1, found] = x
    return found + (abs(value) < touching * magnitude)
