"""Intersection of three homogeneous quadrics in four unknowns, for the minimal solver.

Two unknowns are eliminated with the identities between the monomials y^2, yz and z^2 (Kukelova,
Heller, Fitzgibbon, "Efficient intersection of three quadrics", 2016). Newton steps on the quadrics
polish the roots of the remaining polynomial of degree 8.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inline, kernel
from cadalign.solvers.linalg import Triple, add, cross, dot, subtract
from cadalign.solvers.polynomial import ROOTS_ROWS, real_roots

_DEGREE = 8
_TOUCHING = 1e-7
_POLISH_STEPS = 5
_LARGEST_RESIDUAL = 1e-7  # largest value of a quadric at an intersection, relative to its summands
_LAST_STEP_RESIDUAL = 1e-11  # below it, one Newton step reaches rounding error
_LEAST_DEPTH_TO_POLISH = -0.05  # relative to half their sum; polishing cannot make less positive
_SAME_POINT = 1e-6  # relative difference of depths below which two solutions are equal

Pair = tuple[float, float]
Quadruple = tuple[float, float, float, float]
Quintuple = tuple[float, float, float, float, float]
Sextuple = tuple[float, float, float, float, float, float]


# Rows of the scratch memory; for a single array see `real_roots`.
QUADRICS = 0
"""First of 3 rows of coefficients of e_i e_l for i <= l: 00, 01, 02, 03, 11, 12, 13, 22, 23, 33."""
POINTS = 3
"""First of the rows of the intersections."""
_TABLE = POINTS + 2 * _DEGREE  # see `_solve_for_monomials`
_SYSTEM = _TABLE + 3  # see `_eliminate`
_POLYNOMIAL = _SYSTEM + 9
INTERSECTION_ROWS = _POLYNOMIAL + ROOTS_ROWS
"""Rows of memory (16 numbers each) for `intersect_quadrics`."""


@inline
def intersect_quadrics(memory: FloatArray) -> int:
    """Intersect three quadrics in points e with positive depths H e / 2; returns their number.

    For H see `hadamard`; e_0 is 1. ``memory`` (`INTERSECTION_ROWS`, 16) holds the quadrics in the
    rows from `QUADRICS`, and receives the points in the rows from `POINTS`.
    """
    # Eliminate the pair y, z with the largest determinant of the coefficients of y^2, yz, z^2.
    x, y, z, best = 1, 2, 3, -1.0
    for i in range(1, 4):
        j, k = i % 3 + 1, (i + 1) % 3 + 1
        across = cross(_quadric(memory, _entry(j, k)), _quadric(memory, _entry(k, k)))
        size = abs(dot(_quadric(memory, _entry(j, j)), across))
        if size > best:
            x, y, z, best = i, j, k, size
    if not best > 0.0:
        return 0
    _solve_for_monomials(memory, x, y, z)
    _eliminate(memory)
    number = real_roots(memory, _POLYNOMIAL, _DEGREE, 1.0, _TOUCHING)
    found = 0
    for r in range(number):
        row = POINTS + found
        root = memory[_POLYNOMIAL + 1, r]
        memory[row, 0], memory[row, x] = 1.0, root
        memory[row, y], memory[row, z] = _back_substitute(memory, root)
        if not _least_depth(memory, row) > _LEAST_DEPTH_TO_POLISH or not _polish(memory, row):
            continue
        if _least_depth(memory, row) > 0.0:
            is_new = True
            for k in range(POINTS, row):
                is_new = is_new and not _are_one_root(memory, row, k)
            found += is_new
    return found


@inline
def hadamard(a: float, b: float, c: float, d: float) -> Quadruple:
    """Multiply (a, b, c, d) by half the Hadamard matrix H, an involution: mean and differences."""
    s, t, u, v = a + c, b + d, a - c, b - d
    return 0.5 * (s + t), 0.5 * (s - t), 0.5 * (u + v), 0.5 * (u - v)


@inline
def _least_depth(memory: FloatArray, row: int) -> float:
    a, b, c, d = hadamard(memory[row, 0], memory[row, 1], memory[row, 2], memory[row, 3])
    return min(min(a, b), min(c, d))


@inline
def _are_one_root(memory: FloatArray, row: int, other: int) -> bool:
    difference = 0.0
    for i in range(1, 4):
        difference = max(difference, abs(memory[row, i] - memory[other, i]))
    return difference < _SAME_POINT


@inline
def _entry(i: int, j: int) -> int:
    low, high = min(i, j), max(i, j)
    return low * 4 - low * (low - 1) // 2 + high - low


@inline
def _quadric(memory: FloatArray, k: int) -> Triple:
    return memory[QUADRICS, k], memory[QUADRICS + 1, k], memory[QUADRICS + 2, k]


@inline
def _solve_for_monomials(memory: FloatArray, x: int, y: int, z: int) -> None:
    """Solve for y^2, yz, z^2: write coefficients of 1, x, x^2, y, xy, z, xz from row `_TABLE`."""
    products = (0, x, _entry(x, x), y, _entry(x, y), z, _entry(x, z))
    a = _quadric(memory, _entry(y, y))
    b = _quadric(memory, _entry(y, z))
    c = _quadric(memory, _entry(z, z))
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    scale = -1.0 / dot(a, bc)
    for k in range(7):
        column = _quadric(memory, products[k])
        memory[_TABLE, k] = scale * dot(bc, column)
        memory[_TABLE + 1, k] = scale * dot(ca, column)
        memory[_TABLE + 2, k] = scale * dot(ab, column)


@inline
def _eliminate(memory: FloatArray) -> None:
    """Write three equations linear in y and z, and their determinant, of degree 8 in x.

    The coefficients of y^2 = a0 + a1 y + a2 z, yz = b0 + b1 y + b2 z and z^2 = c0 + c1 y + c2 z are
    polynomials in x. The equations are the identities z (y^2) = y (yz), y (z^2) = z (yz) and
    (yz)^2 = (y^2)(z^2). Rows 3 r to 3 r + 2 from `_SYSTEM` receive the coefficients of y, z and 1
    in identity r. The determinant is expanded in coefficients, not interpolated from values, since
    roots may be a hundred times smaller than 1.
    """
    a0, b0, c0 = _parabola(memory, 0), _parabola(memory, 1), _parabola(memory, 2)
    a1, b1, c1 = _line(memory, 0, 3), _line(memory, 1, 3), _line(memory, 2, 3)
    a2, b2, c2 = _line(memory, 0, 5), _line(memory, 1, 5), _line(memory, 2, 5)
    d, e = (a1[0] - b2[0], a1[1] - b2[1]), (c2[0] - b1[0], c2[1] - b1[1])
    y1 = subtract(subtract(_multiply_22(a2, c1), _multiply_22(b1, b2)), b0)  # equal to z2
    z1 = add(add(_multiply_22(d, b2), _multiply_22(a2, e)), a0)
    w1 = _subtract_4(_add_4(_multiply_23(d, b0), _multiply_23(a2, c0)), _multiply_23(b1, a0))
    y2 = add(add(_multiply_22(c1, d), _multiply_22(e, b1)), c0)
    w2 = _subtract_4(_add_4(_multiply_23(c1, a0), _multiply_23(e, b0)), _multiply_23(b2, c0))
    yy = subtract(_multiply_22(b1, b1), _multiply_22(a1, c1))
    zz = subtract(_multiply_22(b2, b2), _multiply_22(a2, c2))
    b12 = _multiply_22(b1, b2)
    yz = subtract(subtract(add(b12, b12), _multiply_22(a1, c2)), _multiply_22(a2, c1))
    f, g, h = add(b0, yz), subtract(zz, a0), subtract(yy, c0)
    y3 = _add_4(_add_4(_multiply_23(b1, add(b0, f)), _multiply_23(c1, g)), _multiply_23(a1, h))
    z3 = _add_4(_add_4(_multiply_23(b2, add(b0, f)), _multiply_23(c2, g)), _multiply_23(a2, h))
    w3 = _add_5(_add_5(_multiply_33(b0, f), _multiply_33(c0, g)), _multiply_33(yy, a0))
    _write_row(memory, 0, (y1[0], y1[1], y1[2], 0.0, 0.0))
    _write_row(memory, 1, (z1[0], z1[1], z1[2], 0.0, 0.0))
    _write_row(memory, 2, (w1[0], w1[1], w1[2], w1[3], 0.0))
    _write_row(memory, 3, (y2[0], y2[1], y2[2], 0.0, 0.0))
    _write_row(memory, 4, (y1[0], y1[1], y1[2], 0.0, 0.0))
    _write_row(memory, 5, (w2[0], w2[1], w2[2], w2[3], 0.0))
    _write_row(memory, 6, (y3[0], y3[1], y3[2], y3[3], 0.0))
    _write_row(memory, 7, (z3[0], z3[1], z3[2], z3[3], 0.0))
    _write_row(memory, 8, w3)
    y, other_y = _multiply_34(z1, w2), _multiply_34(y1, w1)
    z, other_z = _multiply_34(y2, w1), _multiply_34(y1, w2)
    w, other_w = _multiply_33(y1, y1), _multiply_33(y2, z1)
    for k in range(_DEGREE + 1):
        memory[_POLYNOMIAL, k] = 0.0
    for i in range(6):
        for k in range(4):
            share = (y[i] - other_y[i]) * y3[k] + (z[i] - other_z[i]) * z3[k]
            memory[_POLYNOMIAL, i + k] += share
    for i in range(5):
        for k in range(5):
            memory[_POLYNOMIAL, i + k] += (w[i] - other_w[i]) * w3[k]


@inline
def _line(memory: FloatArray, row: int, first: int) -> Pair:
    return memory[_TABLE + row, first], memory[_TABLE + row, first + 1]


@inline
def _parabola(memory: FloatArray, row: int) -> Triple:
    return memory[_TABLE + row, 0], memory[_TABLE + row, 1], memory[_TABLE + row, 2]


@inline
def _write_row(memory: FloatArray, row: int, values: Quintuple) -> None:
    for k in range(5):
        memory[_SYSTEM + row, k] = values[k]


@kernel
def _back_substitute(memory: FloatArray, x: float) -> tuple[float, float]:
    """Solve the linear system for y and z at a root x, by the best of three cross products."""
    first = (_evaluate_row(memory, 0, x), _evaluate_row(memory, 1, x), _evaluate_row(memory, 2, x))
    second = (_evaluate_row(memory, 3, x), _evaluate_row(memory, 4, x), _evaluate_row(memory, 5, x))
    third = (_evaluate_row(memory, 6, x), _evaluate_row(memory, 7, x), _evaluate_row(memory, 8, x))
    a, b, c = dot(first, first), dot(second, second), dot(third, third)
    y = z = 0.0
    best = -1.0
    for one, other, squares in (
        (first, second, a * b),
        (second, third, b * c),
        (third, first, c * a),
    ):
        product = cross(one, other)
        size = dot(product, product) / squares
        if size > best and product[2] != 0.0:
            y, z, best = product[0] / product[2], product[1] / product[2], size
    return y, z


@inline
def _evaluate_row(memory: FloatArray, row: int, x: float) -> float:
    m, r = memory, _SYSTEM + row
    return float(m[r, 0] + x * (m[r, 1] + x * (m[r, 2] + x * (m[r, 3] + x * m[r, 4]))))


@inline
def _half_gradient(memory: FloatArray, r: int, b: float, c: float, d: float) -> Quadruple:
    """Half the gradient of a quadric at (1, b, c, d); times the point it gives the value."""
    q = memory
    return (
        q[r, 0] + 0.5 * (q[r, 1] * b + q[r, 2] * c + q[r, 3] * d),
        q[r, 4] * b + 0.5 * (q[r, 1] + q[r, 5] * c + q[r, 6] * d),
        q[r, 7] * c + 0.5 * (q[r, 2] + q[r, 5] * b + q[r, 8] * d),
        q[r, 9] * d + 0.5 * (q[r, 3] + q[r, 6] * b + q[r, 8] * c),
    )


@kernel
def _polish(memory: FloatArray, row: int) -> bool:
    """Improve the intersection in a row by Newton's method; False if it is not one."""
    b, c, d = memory[row, 1], memory[row, 2], memory[row, 3]
    error = np.inf
    for iteration in range(_POLISH_STEPS + 1):
        f = _half_gradient(memory, QUADRICS + 0, b, c, d)
        g = _half_gradient(memory, QUADRICS + 1, b, c, d)
        h = _half_gradient(memory, QUADRICS + 2, b, c, d)
        values = (
            f[0] + f[1] * b + f[2] * c + f[3] * d,
            g[0] + g[1] * b + g[2] * c + g[3] * d,
            h[0] + h[1] * b + h[2] * c + h[3] * d,
        )
        sizes = (
            abs(f[0]) + abs(f[1] * b) + abs(f[2] * c) + abs(f[3] * d),
            abs(g[0]) + abs(g[1] * b) + abs(g[2] * c) + abs(g[3] * d),
            abs(h[0]) + abs(h[1] * b) + abs(h[2] * c) + abs(h[3] * d),
        )
        error = max(
            max(abs(values[0]) / sizes[0], abs(values[1]) / sizes[1]), abs(values[2]) / sizes[2]
        )
        if iteration == _POLISH_STEPS or error < 1e-15 or not error < 1e3:
            break
        # Cramer's rule: the columns of the adjugate are cross products of the rows.
        fg, gh, hf = cross(f[1:], g[1:]), cross(g[1:], h[1:]), cross(h[1:], f[1:])
        determinant = dot(f[1:], gh)
        if determinant == 0.0:
            break
        scale = 0.5 / determinant
        b -= scale * (values[0] * gh[0] + values[1] * hf[0] + values[2] * fg[0])
        c -= scale * (values[0] * gh[1] + values[1] * hf[1] + values[2] * fg[1])
        d -= scale * (values[0] * gh[2] + values[1] * hf[2] + values[2] * fg[2])
        if error < _LAST_STEP_RESIDUAL:
            break
    memory[row, 1], memory[row, 2], memory[row, 3] = b, c, d
    return error < _LARGEST_RESIDUAL


# Sums and products of polynomials, constant first; a name ends in the numbers of coefficients.


@inline
def _add_4(p: Quadruple, q: Quadruple) -> Quadruple:
    return p[0] + q[0], p[1] + q[1], p[2] + q[2], p[3] + q[3]


@inline
def _add_5(p: Quintuple, q: Quintuple) -> Quintuple:
    return p[0] + q[0], p[1] + q[1], p[2] + q[2], p[3] + q[3], p[4] + q[4]


@inline
def _subtract_4(p: Quadruple, q: Quadruple) -> Quadruple:
    return p[0] - q[0], p[1] - q[1], p[2] - q[2], p[3] - q[3]


@inline
def _multiply_22(p: Pair, q: Pair) -> Triple:
    return p[0] * q[0], p[0] * q[1] + p[1] * q[0], p[1] * q[1]


@inline
def _multiply_23(p: Pair, q: Triple) -> Quadruple:
    return (
        p[0] * q[0],
        p[0] * q[1] + p[1] * q[0],
        p[0] * q[2] + p[1] * q[1],
        p[1] * q[2],
    )


@inline
def _multiply_33(p: Triple, q: Triple) -> Quintuple:
    return (
        p[0] * q[0],
        p[0] * q[1] + p[1] * q[0],
        p[0] * q[2] + p[1] * q[1] + p[2] * q[0],
        p[1] * q[2] + p[2] * q[1],
        p[2] * q[2],
    )


@inline
def _multiply_34(p: Triple, q: Quadruple) -> Sextuple:
    return (
        p[0] * q[0],
        p[0] * q[1] + p[1] * q[0],
        p[0] * q[2] + p[1] * q[1] + p[2] * q[0],
        p[0] * q[3] + p[1] * q[2] + p[2] * q[1],
        p[1] * q[3] + p[2] * q[2],
        p[2] * q[3],
    )
