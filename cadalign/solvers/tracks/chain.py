"""Normal equations of successive frames that share a border, factorized in linear time.

The unknowns are twelve for each of P frames, pose and velocity, and b that all share. A frame has
products with the next one and with the border alone, so that eliminating one frame after the other
fills nothing in. The inverse has the blocks of that pattern from the last frame to the first
(Takahashi, Fagan, Chen, "Formation of a sparse bus impedance matrix", 1973).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.linalg import factorize, invert_factor, solve_factor

STATE = 12
"""Unknowns of a frame: rotation, translation, angular and linear velocity."""


class Chain(NamedTuple):
    """A symmetric matrix and a right side.

    ``frames`` (P, 12, 12) are the blocks of each frame, ``later`` (P, 12, 12 + b) its products with
    the next frame and the border, ``border`` (b, b) that of the rest. The ``gradient`` (12 P + b,)
    is the right side of the equations.
    """

    frames: FloatArray
    later: FloatArray
    border: FloatArray
    gradient: FloatArray


@kernel
def empty_chain(frames: int, border: int) -> Chain:
    """Room for a chain."""
    return Chain(
        np.zeros((frames, STATE, STATE)),
        np.zeros((frames, STATE, STATE + border)),
        np.zeros((border, border)),
        np.zeros(STATE * frames + border),
    )


@kernel
def clear_chain(chain: Chain) -> None:
    """Set all entries to zero."""
    for part in (chain.frames.ravel(), chain.later.ravel(), chain.border.ravel()):
        part[:] = 0.0
    chain.gradient[:] = 0.0


@kernel
def copy_chain(source: Chain, target: Chain) -> None:
    """Copy all entries."""
    target.frames.ravel()[:] = source.frames.ravel()
    target.later.ravel()[:] = source.later.ravel()
    target.border.ravel()[:] = source.border.ravel()
    target.gradient[:] = source.gradient


@fast_sums
def factorize_chain(chain: Chain) -> bool:
    """Replace a matrix by its factor: frames and border by Cholesky's, the rest by L^-1 of it.

    Returns False where it is not positive definite. The gradient stays.
    """
    frames, size = chain.frames.shape[0], chain.border.shape[0]
    for p in range(frames):
        block, later = chain.frames[p], chain.later[p]
        if not factorize(block):
            return False
        is_last = p == frames - 1
        start = STATE if is_last else 0
        for k in range(STATE):
            for j in range(k):
                share = block[k, j]
                for m in range(start, STATE + size):
                    later[k, m] -= share * later[j, m]
            inverse = 1.0 / block[k, k]
            for m in range(start, STATE + size):
                later[k, m] *= inverse
        for k in range(STATE):
            for m in range(size):
                share = later[k, STATE + m]
                for j in range(m + 1):
                    chain.border[m, j] -= share * later[k, STATE + j]
            if is_last:
                continue
            following, coupling = chain.frames[p + 1], chain.later[p + 1]
            for m in range(STATE):
                share = later[k, m]
                for j in range(m + 1):
                    following[m, j] -= share * later[k, j]
                for j in range(size):
                    coupling[m, STATE + j] -= share * later[k, STATE + j]
    return factorize(chain.border)


@fast_sums
def solve_chain(factor: Chain, gradient: FloatArray, step: FloatArray) -> None:
    """Write the solution of ``matrix @ step = -gradient`` with the factor of the matrix."""
    frames, size = factor.frames.shape[0], factor.border.shape[0]
    for k in range(step.shape[0]):
        step[k] = -gradient[k]
    shared = step[STATE * frames :]
    for p in range(frames):
        block, later = factor.frames[p], factor.later[p]
        own = step[STATE * p : STATE * (p + 1)]
        for k in range(STATE):
            for j in range(k):
                own[k] -= block[k, j] * own[j]
            own[k] /= block[k, k]
        for k in range(STATE):
            for m in range(size):
                shared[m] -= later[k, STATE + m] * own[k]
            if p < frames - 1:
                for m in range(STATE):
                    step[STATE * (p + 1) + m] -= later[k, m] * own[k]
    solve_factor(factor.border, shared)
    for p in range(frames - 1, -1, -1):
        block, later = factor.frames[p], factor.later[p]
        own = step[STATE * p : STATE * (p + 1)]
        for k in range(STATE):
            total = 0.0
            for m in range(size):
                total += later[k, STATE + m] * shared[m]
            if p < frames - 1:
                for m in range(STATE):
                    total += later[k, m] * step[STATE * (p + 1) + m]
            own[k] -= total
        for k in range(STATE - 1, -1, -1):
            for j in range(k + 1, STATE):
                own[k] -= block[j, k] * own[j]
            own[k] /= block[k, k]


@kernel
def invert_chain(factor: Chain) -> Chain:
    """Blocks of the inverse matrix in the pattern of a chain, from the factor of the matrix."""
    frames, size = factor.frames.shape[0], factor.border.shape[0]
    inverse = empty_chain(frames, size)
    triangle = invert_factor(factor.border)
    inverse.border[:] = triangle.T @ triangle
    rest = np.zeros((STATE + size, STATE + size))  # of the next frame and the border
    rest[STATE:, STATE:] = inverse.border
    for p in range(frames - 1, -1, -1):
        lower = invert_factor(factor.frames[p].copy())
        gain = lower.T @ factor.later[p].copy()  # - d(frame) / d(next frame, border)
        across = gain @ rest
        inverse.later[p] = -across
        inverse.frames[p] = lower.T @ lower + across @ gain.T
        rest[:STATE, :STATE] = inverse.frames[p]
        rest[:STATE, STATE:] = inverse.later[p, :, STATE:]
        rest[STATE:, :STATE] = inverse.later[p, :, STATE:].T
    return inverse
