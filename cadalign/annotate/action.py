"""Base of the page's actions, and the outcome of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.annotate.document import Pixel
from cadalign.annotate.objects import PhotoState
from cadalign.annotate.session import Session
from cadalign.errors import InputError
from cadalign.io.documents import ForeignDocument


@dataclass(frozen=True)
class ActionOutcome:
    """Outcome of an action beside the changed document, for the user."""

    selected: int | None = None  # number of the pair that was placed or changed
    message: str = ""  # such as that the click missed the model
    shown: PhotoState | None = None  # the object and photo to go on with, if not the same


class Action(ForeignDocument):
    """Base of the actions; ``pair`` fields are numbers of pairs."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        """Record the changed document, or raise a CadalignError."""
        raise NotImplementedError


def inside(uv: Pixel, state: PhotoState) -> Pixel:
    """Refuse a place outside the photo."""
    if not state.intrinsics.camera.contains(np.array([uv]))[0]:
        raise InputError(
            f"({uv[0]:.1f}, {uv[1]:.1f}) is outside the photo", where="uv", fix="place it inside"
        )
    return uv
