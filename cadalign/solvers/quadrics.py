"""Common roots of three homogeneous quadrics in four unknowns, for the minimal solver.

Two unknowns are eliminated by the identities between the monomials y^2, yz and z^2, after Kukelova,
Heller, Fitzgibbon, "Efficient intersection of three quadrics", 2016; the roots of the remaining
polynomial of degree 8 are polished on the quadrics.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.linalg import Triple, cross, dot
from cadalign.solvers.polynomial import ROOTS_ROWS, real_roots

_DEGREE = 8
_TOUCHING = 1e-7
_POLISH_STEPS = 5
_EXACT = 1e-7  # largest value of a quadric, over its summands, at an intersection
_ALMOST_EXACT = 1e-11  # after which one step of Newton's method reaches rounding
_FAR_BEHIND = -0.05  # depth, over half the sum of all, that polishing cannot make positive
_SAME = 1e-6  # relative difference of depths below which two solutions are one

Quadruple = tuple[float, float, float, float]


# Rows of the memory, which is a single array for the reason given in `real_roots`.
QUADRICS = 0
"""First of 3 rows of coefficients of e_i e_l for i <= l: 00, 01, 02, 03, 11, 12, 13, 22, 23, 33."""
POINTS = 3
"""First of the rows of the intersections."""
_A = POINTS + 2 * _DEGREE  # see `_eliminate`
_B = _A + 3
_C = _B + 3
_D = _C + 3
_SYSTEM = _D + 6
_POLYNOMIAL = _SYSTEM + 9
INTERSECTION_ROWS = _POLYNOMIAL + ROOTS_ROWS
"""Rows of 16 numbers that `intersect_quadrics` uses."""


@inlined
def intersect_quadrics(memory: FloatArray) -> int:
    """Find the points e at which three quadrics meet and the depths H e / 2 are positive.

    H is the Hadamard matrix (see `hadamard`): the common depth e_0 is 1, the others are differences
    between -1 and 1. ``memory`` (`INTERSECTION_ROWS`, 16) holds the quadrics in the rows from
    `QUADRICS`, and receives the points in those from `POINTS`. Returns their number.
    """
    # Eliminate the pair of differences for which the quadrics tell y^2, yz, z^2 best.
    x, y, z, best = 1, 2, 3, -1.0
    for i in range(1, 4):
        j, k = i % 3 + 1, (i + 1) % 3 + 1
        across = cross(_column(memory, _entry(j, k)), _column(memory, _entry(k, k)))
        size = abs(dot(_column(memory, _entry(j, j)), across))
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
        if not _least_depth(memory, row) > _FAR_BEHIND or not _polish(memory, row):
            continue
        if _least_depth(memory, row) > 0.0:
            is_new = True
            for k in range(POINTS, row):
                is_new = is_new and not _are_same(memory, row, k)
            found += is_new
    return found


@inlined
def hadamard(a: float, b: float, c: float, d: float) -> Quadruple:
    """H v / 2 for a vector v = (a, b, c, d), an involution: the common part and differences."""
    s, t, u, v = a + c, b + d, a - c, b - d
    return 0.5 * (s + t), 0.5 * (s - t), 0.5 * (u + v), 0.5 * (u - v)


@inlined
def _least_depth(memory: FloatArray, row: int) -> float:
    a, b, c, d = hadamard(memory[row, 0], memory[row, 1], memory[row, 2], memory[row, 3])
    return min(min(a, b), min(c, d))


@inlined
def _are_same(memory: FloatArray, row: int, other: int) -> bool:
    difference = 0.0
    for i in range(1, 4):
        difference = max(difference, abs(memory[row, i] - memory[other, i]))
    return difference < _SAME


@inlined
def _entry(i: int, j: int) -> int:
    """Position of the coefficient of e_i e_j in a row of quadrics."""
    low, high = min(i, j), max(i, j)
    return low * 4 - low * (low - 1) // 2 + high - low


@inlined
def _column(memory: FloatArray, k: int) -> Triple:
    return memory[QUADRICS, k], memory[QUADRICS + 1, k], memory[QUADRICS + 2, k]


@inlined
def _solve_for_monomials(memory: FloatArray, x: int, y: int, z: int) -> None:
    """Solve for y^2, yz and z^2: coefficients of 1, x, x^2, of y, xy, and of z, xz, in own rows."""
    products = (0, x, _entry(x, x), y, _entry(x, y), z, _entry(x, z))
    a = _column(memory, _entry(y, y))
    b = _column(memory, _entry(y, z))
    c = _column(memory, _entry(z, z))
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    scale = -1.0 / dot(a, bc)
    for k in range(7):
        column = _column(memory, products[k])
        part = 0 if k < 3 else (k - 1) // 2
        power = k if k < 3 else (k - 1) % 2
        memory[_A + part, power] = scale * dot(bc, column)
        memory[_B + part, power] = scale * dot(ca, column)
        memory[_C + part, power] = scale * dot(ab, column)


@inlined
def _eliminate(memory: FloatArray) -> None:
    """Write three equations that are linear in y and z, and their determinant, of degree 8 in x.

    With y^2 = a0 + a1 y + a2 z, yz = b0 + b1 y + b2 z, z^2 = c0 + c1 y + c2 z, polynomials in x,
    these are the identities z (y^2) = y (yz), y (z^2) = z (yz) and (yz)^2 = (y^2)(z^2). Rows 3 r
    to 3 r + 2 from `_SYSTEM` receive the coefficients of y, z and 1 in identity r. All that
    is done in coefficients, not in values, since roots may be a hundred times smaller than 1.
    """
    m = memory
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = _A, _A + 1, _A + 2, _B, _B + 1, _B + 2, _C, _C + 1, _C + 2
    d, e, f, g, h, yy = _D, _D + 1, _D + 2, _D + 3, _D + 4, _D + 5
    y1, z1, w1, y2 = _SYSTEM, _SYSTEM + 1, _SYSTEM + 2, _SYSTEM + 3
    z2, w2, y3, z3, w3 = y2 + 1, y2 + 2, y2 + 3, y2 + 4, y2 + 5
    for row in range(_D, _POLYNOMIAL + 1):
        for k in range(_DEGREE + 1):
            m[row, k] = 0.0
    for k in range(2):
        m[d, k], m[e, k] = m[a1, k] - m[b2, k], m[c2, k] - m[b1, k]
    for k in range(3):
        m[y1, k], m[z1, k], m[y2, k] = -m[b0, k], m[a0, k], m[c0, k]
        m[f, k], m[g, k], m[h, k] = m[b0, k], -m[a0, k], -m[c0, k]
    _add_product(m, y1, 1.0, a2, 2, c1, 2)
    _add_product(m, y1, -1.0, b1, 2, b2, 2)
    _add_product(m, z1, 1.0, d, 2, b2, 2)
    _add_product(m, z1, 1.0, a2, 2, e, 2)
    _add_product(m, w1, 1.0, d, 2, b0, 3)
    _add_product(m, w1, 1.0, a2, 2, c0, 3)
    _add_product(m, w1, -1.0, b1, 2, a0, 3)
    _add_product(m, y2, 1.0, c1, 2, d, 2)
    _add_product(m, y2, 1.0, e, 2, b1, 2)
    _add_product(m, w2, 1.0, c1, 2, a0, 3)
    _add_product(m, w2, 1.0, e, 2, b0, 3)
    _add_product(m, w2, -1.0, b2, 2, c0, 3)
    _add_product(m, yy, 1.0, b1, 2, b1, 2)
    _add_product(m, yy, -1.0, a1, 2, c1, 2)
    _add_product(m, g, 1.0, b2, 2, b2, 2)
    _add_product(m, g, -1.0, a2, 2, c2, 2)
    _add_product(m, f, 2.0, b1, 2, b2, 2)
    _add_product(m, f, -1.0, a1, 2, c2, 2)
    _add_product(m, f, -1.0, a2, 2, c1, 2)
    for k in range(3):
        m[z2, k] = m[y1, k]
        m[h, k] += m[yy, k]
    for target, first, last in ((y3, b1, a1), (z3, b2, a2)):
        _add_product(m, target, 1.0, first, 2, b0, 3)
        _add_product(m, target, 1.0, first, 2, f, 3)
        _add_product(m, target, 1.0, last + c1 - a1, 2, g, 3)
        _add_product(m, target, 1.0, last, 2, h, 3)
    _add_product(m, w3, 1.0, b0, 3, f, 3)
    _add_product(m, w3, 1.0, c0, 3, g, 3)
    _add_product(m, w3, 1.0, yy, 3, a0, 3)
    for k in range(6):  # the minors
        m[d, k] = m[e, k] = m[f, k] = 0.0
    _add_product(m, d, 1.0, z1, 3, w2, 4)
    _add_product(m, d, -1.0, y1, 3, w1, 4)
    _add_product(m, e, 1.0, y2, 3, w1, 4)
    _add_product(m, e, -1.0, y1, 3, w2, 4)
    _add_product(m, f, 1.0, y1, 3, y1, 3)
    _add_product(m, f, -1.0, y2, 3, z1, 3)
    _add_product(m, _POLYNOMIAL, 1.0, d, 6, y3, 4)
    _add_product(m, _POLYNOMIAL, 1.0, e, 6, z3, 4)
    _add_product(m, _POLYNOMIAL, 1.0, f, 5, w3, 5)


@inlined
def _add_product(
    memory: FloatArray, target: int, factor: float, row: int, terms: int, other: int, others: int
) -> None:
    """Add a multiple of the product of two polynomials, of so many terms, to a row."""
    for i in range(terms):
        share = factor * memory[row, i]
        for k in range(others):
            memory[target, i + k] += share * memory[other, k]


@kernel
def _back_substitute(memory: FloatArray, x: float) -> tuple[float, float]:
    """The y and z that the linear system has at a root x: the best of three cross products."""
    first = (_at(memory, 0, x), _at(memory, 1, x), _at(memory, 2, x))
    second = (_at(memory, 3, x), _at(memory, 4, x), _at(memory, 5, x))
    third = (_at(memory, 6, x), _at(memory, 7, x), _at(memory, 8, x))
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


@inlined
def _at(memory: FloatArray, row: int, x: float) -> float:
    m, r = memory, _SYSTEM + row
    return float(m[r, 0] + x * (m[r, 1] + x * (m[r, 2] + x * (m[r, 3] + x * m[r, 4]))))


@inlined
def _half_gradient(memory: FloatArray, r: int, b: float, c: float, d: float) -> Quadruple:
    """Half the gradient of a quadric at (1, b, c, d); its product with the point is the value."""
    q = memory
    return (
        q[r, 0] + 0.5 * (q[r, 1] * b + q[r, 2] * c + q[r, 3] * d),
        q[r, 4] * b + 0.5 * (q[r, 1] + q[r, 5] * c + q[r, 6] * d),
        q[r, 7] * c + 0.5 * (q[r, 2] + q[r, 5] * b + q[r, 8] * d),
        q[r, 9] * d + 0.5 * (q[r, 3] + q[r, 6] * b + q[r, 8] * c),
    )


@kernel
def _polish(memory: FloatArray, row: int) -> bool:
    """Improve an intersection, in a row, by Newton's method; False where it is not one."""
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
        # Cramer's rule, with the rows' cross products as the columns of the adjugate.
        fg, gh, hf = cross(f[1:], g[1:]), cross(g[1:], h[1:]), cross(h[1:], f[1:])
        determinant = dot(f[1:], gh)
        if determinant == 0.0:
            break
        scale = 0.5 / determinant
        b -= scale * (values[0] * gh[0] + values[1] * hf[0] + values[2] * fg[0])
        c -= scale * (values[0] * gh[1] + values[1] * hf[1] + values[2] * fg[1])
        d -= scale * (values[0] * gh[2] + values[1] * hf[2] + values[2] * fg[2])
        if error < _ALMOST_EXACT:
            break
    memory[row, 1], memory[row, 2], memory[row, 3] = b, c, d
    return error < _EXACT
