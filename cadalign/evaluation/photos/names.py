"""Names of methods: a base, and the evidence beside the keypoints, as in ``rigid+mask``."""

from __future__ import annotations

from collections.abc import Collection

from cadalign.errors import InputError, quote

EPNP, RIGID, STRETCHED, PRIOR, SIMILAR = "epnp", "rigid", "stretched", "prior", "similar"
SHAPE, TRUTH = "shape", "truth"
BASES = (EPNP, RIGID, STRETCHED, PRIOR, SIMILAR, SHAPE)
MASK, DEPTH, GRAVITY = "mask", "depth", "gravity"
EVIDENCE = (MASK, DEPTH, GRAVITY)


def parts_of(method: str) -> tuple[str, frozenset[str]]:
    """The base of a method, and its evidence.

    Examples
    --------
    >>> base, evidence = parts_of("rigid+mask+depth")
    >>> base, sorted(evidence)
    ('rigid', ['depth', 'mask'])
    """
    base, *evidence = method.split("+")
    return base, frozenset(evidence)


def check_method(method: str) -> None:
    """Check the name of a method.

    Raises
    ------
    InputError
        If there is none of this name, or EPnP or the truth is given evidence.
    """
    base, evidence = parts_of(method)
    is_known = base in (*BASES, TRUTH) and evidence <= set(EVIDENCE)
    if not is_known or method.count("+") != len(evidence):
        fix = f"known are {', '.join((*BASES, TRUTH))}, with {', '.join(f'+{e}' for e in EVIDENCE)}"
        raise InputError(f"unknown method {quote(method)}", where="methods", fix=fix)
    if evidence and base in (EPNP, TRUTH):
        fix = "give rigid, stretched, prior, similar or shape the evidence"
        raise InputError(f"{base} takes keypoints alone", where="methods", fix=fix)


def default_methods(
    *,
    with_evidence: Collection[str],
    evidence: Collection[str],
    has_shape: bool,
    up_axis: str = "y",
) -> tuple[str, ...]:
    """The methods for data that have some evidence, which the given bases get, where they can.

    A shape model has no mesh for a mask; other models must be upright along y for gravity.

    Examples
    --------
    >>> default_methods(with_evidence=("rigid",), evidence={"mask", "depth"}, has_shape=False)[5:]
    ('rigid+mask', 'rigid+depth', 'rigid+mask+depth')
    """
    bases = [base for base in BASES if has_shape or base != SHAPE]
    more = []
    for base in (each for each in with_evidence if each in bases):
        useless = {MASK} if base == SHAPE else {GRAVITY} if up_axis != "y" else set()
        kinds = [kind for kind in EVIDENCE if kind in evidence and kind not in useless]
        sets = [[kind] for kind in kinds] + ([kinds] if len(kinds) > 1 else [])
        more += ["+".join((base, *each)) for each in sets]
    return (*bases, *more)
