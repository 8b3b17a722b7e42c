"""Drawing point numbers in the compiled kernels: reproducible, and the promising ones first."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel

StateArray = npt.NDArray[np.uint64]


@kernel
def seed_state(seed: int, state: StateArray) -> None:
    """Start a random stream (1,) from a seed: one step of SplitMix64, never zero."""
    z = np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    state[0] = z | np.uint64(1)


@kernel
def draw_below(state: StateArray, bound: int) -> int:
    """A whole number from 0 to ``bound - 1``; xorshift64*."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return int(np.int64(((x * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(33)) % np.uint64(bound)))


@kernel
def draw_subset(state: StateArray, count: int, chosen: IntArray) -> None:
    """Draw distinct point numbers below ``count``, any of them alike."""
    k = 0
    while k < chosen.shape[0]:
        index = draw_below(state, count)
        fresh = True
        for m in range(k):
            fresh = fresh and chosen[m] != index
        if fresh:
            chosen[k] = index
            k += 1


@kernel
def next_subset(chosen: IntArray, count: int) -> bool:
    """Step to the next subset in lexicographic order; False after the last."""
    size = chosen.shape[0]
    i = size - 1
    while i >= 0 and chosen[i] == count - size + i:
        i -= 1
    if i < 0:
        return False
    chosen[i] += 1
    for k in range(i + 1, size):
        chosen[k] = chosen[k - 1] + 1
    return True


@kernel
def grow_pool(growth: FloatArray, size: int, count: int, iteration: int) -> None:
    """Widen the pool of the best points as PROSAC does.

    Chum, Matas, "Matching with PROSAC - progressive sample consensus", 2005. ``growth`` (3,) holds
    the pool's size, the average number of samples that fall into it (T_n), and the iteration until
    which it lasts (T'_n).
    """
    while growth[0] < count and iteration > growth[2]:
        wider = growth[1] * (growth[0] + 1) / (growth[0] + 1 - size)
        growth[2] += np.ceil(wider - growth[1])
        growth[1] = wider
        growth[0] += 1


@kernel
def start_pool(growth: FloatArray, size: int, count: int, budget: float) -> None:
    """The pool before the first sample: as many points as a sample has."""
    average = budget
    for i in range(size):
        average *= (size - i) / (count - i)
    growth[0], growth[1], growth[2] = size, average, 1.0


@kernel
def draw_sample(
    state: StateArray, growth: FloatArray, guided: bool, count: int, chosen: IntArray
) -> None:
    """Draw a sample: of the pool's points, with its newest one, or of all."""
    pool = int(growth[0]) if guided else count
    if pool >= count:
        draw_subset(state, count, chosen)
    elif pool == chosen.shape[0]:
        for k in range(pool):
            chosen[k] = k
    else:
        draw_subset(state, pool - 1, chosen[1:])
        chosen[0] = pool - 1
