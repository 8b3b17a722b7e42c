"""The minimal solver: every alignment that reprojects 4 points exactly."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.constants import POSE_SIZE
from cadalign.solvers.linalg import polish_rotation
from cadalign.solvers.polynomial import multiply_add, real_roots

MAX_SOLUTIONS = 8

_TOUCHING = 1e-7
_POLISH_STEPS = 5
_EXACT = 1e-7  # largest value of a quadric, over its summands, at an intersection
# Largest cosine between columns of a rotation. Columns that nearly cancel can be far from
# orthogonal where the quadrics, which are relative to their summands, look exact.
_ORTHOGONAL = 1e-4
_SAME = 1e-6  # relative difference of depths below which two solutions are one


def ap4p(
    points_3d: npt.ArrayLike, rays: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve anisotropic PnP from 4 points, without checking the input's values.

    The four depths are the only unknowns: the columns of ``R diag(scale)`` are linear in them, and
    that these are orthogonal makes three homogeneous quadrics, which meet in at most 8 points. Two
    unknowns are eliminated by the identities between the monomials y^2, yz and z^2, after
    Kukelova, Heller, Fitzgibbon, "Efficient intersection of three quadrics", 2016; the
    positive roots of the remaining polynomial of degree 8 are polished on the quadrics.

    Parameters
    ----------
    points_3d : (4, 3) float
        Model points that span a volume.
    rays : (4, 2) or (4, 3) float
        Normalised image coordinates (u, v), or directions of any length.

    Returns
    -------
    rotations : (k, 3, 3) float
    translations : (k, 3) float
    scales : (k, 3) float
        (1, s_y, s_z) of each of the 0 to 8 solutions with all depths positive, those with the
        least stretch (sum of squared log scales) first. None where the points lie in one plane.
    """
    points = np.ascontiguousarray(points_3d, dtype=np.float64)
    directions = np.ascontiguousarray(rays, dtype=np.float64)
    if directions.shape[1] == 2:
        directions = np.column_stack([directions, np.ones(4)])
    solutions = np.empty((MAX_SOLUTIONS, POSE_SIZE))
    count = ap4p_kernel(points, directions, solutions)
    found = solutions[:count]
    found = found[np.isfinite(found).all(axis=1)]
    found = found[np.argsort((np.log(found[:, 12:]) ** 2).sum(axis=1), kind="stable")]
    return found[:, :9].reshape(-1, 3, 3), found[:, 9:12].copy(), found[:, 12:].copy()


@kernel
def ap4p_kernel(points: FloatArray, rays: FloatArray, solutions: FloatArray) -> int:
    """Compiled `ap4p`: packs its solutions into (8, 15) ``solutions``, returns their number."""
    unit_rays = np.empty((4, 3))
    for i in range(4):
        length = np.sqrt(rays[i, 0] ** 2 + rays[i, 1] ** 2 + rays[i, 2] ** 2)
        for c in range(3):
            unit_rays[i, c] = rays[i, c] / length
    weights = np.empty((3, 4))
    if not _column_weights(points, weights):
        return 0
    quadrics = np.empty((3, 10))
    _orthogonality_quadrics(weights, unit_rays, quadrics)
    depths = np.empty((2 * MAX_SOLUTIONS, 4))
    found = _intersect_quadrics(quadrics, depths)
    count = 0
    for k in range(found):
        if count < MAX_SOLUTIONS and _pose_from_depths(
            points, unit_rays, weights, depths[k], solutions[count]
        ):
            count += 1
    return count


@kernel
def solve_subset(
    points: FloatArray, rays: FloatArray, chosen: IntArray, solutions: FloatArray
) -> int:
    """Solve from the points with the 4 numbers ``chosen``; see `ap4p_kernel`."""
    some = np.empty((4, 3))
    directions = np.ones((4, 3))
    for i in range(4):
        for c in range(3):
            some[i, c] = points[chosen[i], c]
        for c in range(2):
            directions[i, c] = rays[chosen[i], c]
    return ap4p_kernel(some, directions, solutions)


@kernel
def _column_weights(points: FloatArray, weights: FloatArray) -> bool:
    """Find the weights by which the camera-frame points add up to the columns of R diag(s).

    They are the inverse of the matrix of model-frame differences: ``weights`` (3, 4) is such that
    ``sum_i weights[j, i] X_i`` is column j for the camera-frame points X_i. Returns False for
    points in one plane.
    """
    d = np.empty((3, 3))
    largest = 0.0
    for i in range(3):
        for c in range(3):
            d[i, c] = points[i + 1, c] - points[0, c]
            largest = max(largest, abs(d[i, c]))
    inverse = np.empty((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            e, f = (c + 1) % 3, (c + 2) % 3
            inverse[c, i] = d[j, e] * d[k, f] - d[j, f] * d[k, e]
    determinant = d[0, 0] * inverse[0, 0] + d[0, 1] * inverse[1, 0] + d[0, 2] * inverse[2, 0]
    norms = 1.0
    for c in range(3):
        norms *= np.sqrt(d[0, c] ** 2 + d[1, c] ** 2 + d[2, c] ** 2)
    if not abs(determinant) > 1e-9 * norms:
        return False
    for j in range(3):
        total = 0.0
        for i in range(3):
            weights[j, i + 1] = inverse[j, i] / determinant
            total += weights[j, i + 1]
        weights[j, 0] = -total
    return True


@kernel
def _orthogonality_quadrics(weights: FloatArray, rays: FloatArray, quadrics: FloatArray) -> None:
    """Write the quadrics that vanish where two columns are orthogonal.

    Their variables are not the depths d but e = H d / 2 with the Hadamard matrix H: e_0 is the
    common depth, the others are differences. Depths of an object are alike, so polynomials in
    their ratios cancel badly near 1; in e they are evaluated near 0. Positive depths mean
    |e_k| < e_0. Rows are column pairs (0, 1), (0, 2), (1, 2), each scaled to a largest
    coefficient of 1; entries are the coefficients of e_i e_l for i <= l: 00, 01, 02, 03, 11, 12,
    13, 22, 23, 33.
    """
    form = np.empty((4, 4))
    row = 0
    for j in range(2):
        for k in range(j + 1, 3):
            for i in range(4):
                for m in range(4):
                    cosine = (
                        rays[i, 0] * rays[m, 0] + rays[i, 1] * rays[m, 1] + rays[i, 2] * rays[m, 2]
                    )
                    product = weights[j, i] * weights[k, m] + weights[j, m] * weights[k, i]
                    form[i, m] = product * cosine
            for i in range(4):
                _hadamard(form[i])
            for i in range(4):
                _hadamard(form[:, i])
            largest = 0.0
            entry = 0
            for i in range(4):
                for m in range(i, 4):
                    value = form[i, m] if i != m else 0.5 * form[i, i]
                    quadrics[row, entry] = value
                    largest = max(largest, abs(value))
                    entry += 1
            for entry in range(10):
                quadrics[row, entry] /= largest
            row += 1


@kernel
def _hadamard(vector: FloatArray) -> None:
    """Replace a vector v (4,) by H v / 2, an involution: the common part and differences."""
    a, b, c, d = vector[0], vector[1], vector[2], vector[3]
    vector[0] = 0.5 * (a + b + c + d)
    vector[1] = 0.5 * (a - b + c - d)
    vector[2] = 0.5 * (a + b - c - d)
    vector[3] = 0.5 * (a - b - c + d)


@kernel
def _entry(i: int, j: int) -> int:
    """Position of the coefficient of d_i d_j in a row of quadrics."""
    low, high = min(i, j), max(i, j)
    return low * 4 - low * (low - 1) // 2 + high - low


@kernel
def _intersect_quadrics(quadrics: FloatArray, depths: FloatArray) -> int:
    """Find the points at which the three quadrics meet and all four depths are positive.

    Writes the depths, the largest of them 1, into the rows of ``depths``; returns their number.
    """
    # Eliminate the pair of differences for which the quadrics tell y^2, yz, z^2 best.
    x, y, z, best = 1, 2, 3, -1.0
    for i in range(1, 4):
        j, k = i % 3 + 1, (i + 1) % 3 + 1
        size = abs(_minor(quadrics, _entry(j, j), _entry(j, k), _entry(k, k)))
        if size > best:
            x, y, z, best = i, j, k, size
    if not best > 0.0:
        return 0
    table = np.empty((3, 7))
    _solve_for_monomials(quadrics, x, y, z, table)
    matrix = np.zeros((12, 5))
    determinant = np.zeros(9)
    _eliminate(table, matrix, determinant)
    roots = np.empty(2 * MAX_SOLUTIONS)
    number = real_roots(determinant, 8, -1.0, 1.0, _TOUCHING, roots)
    found = 0
    for r in range(number):
        point = depths[found]
        point[0], point[x] = 1.0, roots[r]
        point[y], point[z] = _back_substitute(matrix, roots[r])
        if not _polish(quadrics, point):
            continue
        _hadamard(point)
        largest = max(max(point[0], point[1]), max(point[2], point[3]))
        if point[0] > 0 and point[1] > 0 and point[2] > 0 and point[3] > 0:
            for i in range(4):
                point[i] /= largest
            is_new = True
            for k in range(found):
                difference = 0.0
                for i in range(4):
                    difference = max(difference, abs(depths[k, i] - point[i]))
                is_new = is_new and difference >= _SAME
            found += is_new
    return found


@kernel
def _minor(quadrics: FloatArray, a: int, b: int, c: int) -> float:
    """Determinant of three columns."""
    q = quadrics
    return float(
        q[0, a] * (q[1, b] * q[2, c] - q[1, c] * q[2, b])
        - q[0, b] * (q[1, a] * q[2, c] - q[1, c] * q[2, a])
        + q[0, c] * (q[1, a] * q[2, b] - q[1, b] * q[2, a])
    )


@kernel
def _solve_for_monomials(quadrics: FloatArray, x: int, y: int, z: int, table: FloatArray) -> None:
    """Solve for y^2, yz and z^2 (rows of ``table``): coefficients of 1, x, x^2 | y, xy | z, xz."""
    products = ((0, 0), (x, 0), (x, x), (y, 0), (x, y), (z, 0), (x, z))
    a, b, c = _entry(y, y), _entry(y, z), _entry(z, z)
    determinant = _minor(quadrics, a, b, c)
    for k in range(7):
        column = _entry(products[k][0], products[k][1])
        table[0, k] = -_minor(quadrics, column, b, c) / determinant
        table[1, k] = -_minor(quadrics, a, column, c) / determinant
        table[2, k] = -_minor(quadrics, a, b, column) / determinant


# With y^2 = a0 + a1 y + a2 z, yz = b0 + b1 y + b2 z, z^2 = c0 + c1 y + c2 z, polynomials in x, the
# identities z (y^2) = y (yz), y (z^2) = z (yz) and (yz)^2 = (y^2)(z^2) become linear in (y, z, 1).
_KNOWN = ("a0", "a1", "a2", "b0", "b1", "b2", "c0", "c1", "c2")
_PLACES = np.array([0, 3, 5, 7, 10, 12, 14, 17, 19, 21])  # of their coefficients in a flat table
_SUMS = (
    "1 a2 c1 -1 b1 b2",  # y, z and 1 in the first identity
    "1 a1 b2 1 a2 c2 -1 b1 a2 -1 b2 b2",
    "1 a1 b0 1 a2 c0 -1 b1 a0 -1 b2 b0",
    "1 c1 a1 1 c2 b1 -1 b1 b1 -1 b2 c1",  # in the second
    "1 c1 a2 -1 b1 b2",
    "1 c1 a0 1 c2 b0 -1 b1 b0 -1 b2 c0",
    "2 b0 b1 -1 a0 c1 -1 a1 c0",  # in the third
    "2 b0 b2 -1 a0 c2 -1 a2 c0",
    "1 b0 b0 -1 a0 c0",
    "1 b1 b1 -1 a1 c1",  # y^2, yz and z^2 in the third
    "2 b1 b2 -1 a1 c2 -1 a2 c1",
    "1 b2 b2 -1 a2 c2",
)


def _products() -> IntArray:
    """Expand `_SUMS` into rows: sum, power of x, factor, and places of the two coefficients."""
    rows = []
    for row, text in enumerate(_SUMS):
        words = text.split()
        for factor, *pair in zip(words[::3], words[1::3], words[2::3], strict=True):
            a, b = (range(*_PLACES[_KNOWN.index(name) :][:2]) for name in pair)
            rows += [(row, i - a[0] + j - b[0], int(factor), i, j) for i in a for j in b]
    return np.array(rows)


_PRODUCTS = _products()


@kernel
def _eliminate(table: FloatArray, matrix: FloatArray, determinant: FloatArray) -> None:
    """Turn the three identities between the monomials into a 3 x 3 matrix over polynomials in x.

    Rows 3 r ... 3 r + 2 of ``matrix`` (12, 5) receive the coefficients of y, z and 1 in identity r;
    their determinant has degree 8. The last three rows are scratch space.
    """
    known = table.reshape(21)
    for t in range(_PRODUCTS.shape[0]):
        row, power, factor = _PRODUCTS[t, 0], _PRODUCTS[t, 1], _PRODUCTS[t, 2]
        matrix[row, power] += factor * known[_PRODUCTS[t, 3]] * known[_PRODUCTS[t, 4]]
    for k in range(3):
        matrix[0, k] -= table[1, k]
        matrix[1, k] += table[0, k]
        matrix[3, k] += table[2, k]
        matrix[4, k] -= table[1, k]
    for k in range(3):
        multiply_add(matrix[6], matrix[9 + k, :3], table[k, 3:5], 1.0)
        multiply_add(matrix[7], matrix[9 + k, :3], table[k, 5:7], 1.0)
        multiply_add(matrix[8], matrix[9 + k, :3], table[k, 0:3], 1.0)
    product = np.zeros(7)
    for k in range(3):  # expand along the first identity
        p, q = (k + 1) % 3, (k + 2) % 3
        product[:] = 0.0
        multiply_add(product, matrix[3 + p, :4], matrix[6 + q], 1.0)
        multiply_add(product, matrix[3 + q, :4], matrix[6 + p], -1.0)
        # Each entry has the degree 2 or 3 and its minor 6 or 5: together never more than 8.
        for i in range(4):
            for j in range(9 - i if i > 2 else 7):
                determinant[i + j] += matrix[k, i] * product[j]


@kernel
def _back_substitute(matrix: FloatArray, x: float) -> tuple[float, float]:
    """The y and z that the linear system has at a root x: the best of three cross products."""
    values = np.empty((3, 3))
    for r in range(3):
        norm = 0.0
        for c in range(3):
            total = 0.0
            for k in range(4, -1, -1):
                total = total * x + matrix[3 * r + c, k]
            values[r, c] = total
            norm += total * total
        norm = np.sqrt(norm) if norm > 0 else 1.0
        for c in range(3):
            values[r, c] /= norm
    best = -1.0
    y = z = 0.0
    for r in range(3):
        a, b = values[r], values[(r + 1) % 3]
        p = a[1] * b[2] - a[2] * b[1]
        q = a[2] * b[0] - a[0] * b[2]
        s = a[0] * b[1] - a[1] * b[0]
        size = p * p + q * q + s * s
        if size > best and s != 0.0:
            y, z, best = p / s, q / s, size
    return y, z


@kernel
def _polish(quadrics: FloatArray, point: FloatArray) -> bool:
    """Improve an intersection, at point[0] = 1, by Newton's method; False where it is not one."""
    jacobian = np.empty((3, 3))
    values = np.empty(3)
    change = np.empty(3)
    a, b, c, d = point[0], point[1], point[2], point[3]
    error = np.inf
    for iteration in range(_POLISH_STEPS + 1):
        error = 0.0
        for r in range(3):
            q = quadrics[r]
            # Half the gradient; its product with the point is the quadric's value.
            g0 = q[0] * a + 0.5 * (q[1] * b + q[2] * c + q[3] * d)
            g1 = q[4] * b + 0.5 * (q[1] * a + q[5] * c + q[6] * d)
            g2 = q[7] * c + 0.5 * (q[2] * a + q[5] * b + q[8] * d)
            g3 = q[9] * d + 0.5 * (q[3] * a + q[6] * b + q[8] * c)
            values[r] = 0.5 * (g0 * a + g1 * b + g2 * c + g3 * d)
            size = abs(g0 * a) + abs(g1 * b) + abs(g2 * c) + abs(g3 * d)
            error = max(error, abs(values[r]) / size)
            jacobian[r, 0], jacobian[r, 1], jacobian[r, 2] = g1, g2, g3
        if iteration == _POLISH_STEPS or error < 1e-15 or not error < 1e3:
            break
        determinant = _minor(jacobian, 0, 1, 2)
        if determinant == 0.0:
            break
        for k in range(3):  # Cramer's rule
            for r in range(3):  # swap them, and back below
                jacobian[r, k], values[r] = values[r], jacobian[r, k]
            change[k] = _minor(jacobian, 0, 1, 2) / determinant
            for r in range(3):
                jacobian[r, k], values[r] = values[r], jacobian[r, k]
        b, c, d = b - change[0], c - change[1], d - change[2]
    point[1], point[2], point[3] = b, c, d
    return error < _EXACT


@kernel
def _pose_from_depths(
    points: FloatArray, rays: FloatArray, weights: FloatArray, depths: FloatArray, pose: FloatArray
) -> bool:
    """Pack rotation, translation and scale; False for a mirrored or inexact solution."""
    columns = np.zeros((3, 3))
    for j in range(3):
        for i in range(4):
            for c in range(3):
                columns[c, j] += weights[j, i] * depths[i] * rays[i, c]
    if not _minor(columns, 0, 1, 2) > 0:
        return False
    lengths = np.empty(3)
    for j in range(3):
        lengths[j] = np.sqrt(columns[0, j] ** 2 + columns[1, j] ** 2 + columns[2, j] ** 2)
        for c in range(3):
            columns[c, j] /= lengths[j]
    for j in range(3):
        cosine = 0.0
        for c in range(3):
            cosine += columns[c, j] * columns[c, (j + 1) % 3]
        if not abs(cosine) < _ORTHOGONAL:
            return False
    rotation = pose[:9].reshape(3, 3)
    polish_rotation(columns, rotation)
    for j in range(3):
        pose[12 + j] = lengths[j] / lengths[0]
    for c in range(3):
        total = 0.0
        for i in range(4):
            total += depths[i] * rays[i, c] / lengths[0]
            for j in range(3):
                total -= rotation[c, j] * pose[12 + j] * points[i, j]
        pose[9 + c] = total / 4.0
    return True
