"""A session of annotating: the photos, what was placed in them, and every action on it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.alignment import Lens, LiveAlignment, align
from cadalign.annotate.document import Document, FocalChoice, Pixel
from cadalign.annotate.files import Sheet, sigmas_of, write_keypoints
from cadalign.annotate.history import History
from cadalign.annotate.keypoint_book import KeypointBook
from cadalign.annotate.model import CadModel
from cadalign.annotate.photos import Photo
from cadalign.annotate.suggestion import Suggestion, suggest
from cadalign.annotate.wireframe import Wireframe
from cadalign.errors import CadalignError, InputError
from cadalign.evaluation.simulation.problems import simulate_problem
from cadalign.io.documents import Finite, Index, Text, convert

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length, in image widths


@dataclass
class Slide:
    """One photo and its annotation.

    Parameters
    ----------
    photo : Photo
    sheet : Sheet
        Its files.
    lens : Lens
    history : History
    """

    photo: Photo
    sheet: Sheet
    lens: Lens
    history: History
    saved_at: float | None = None
    trouble: str = ""
    fit_waits: bool = False
    """Whether the alignment's file is to be written once there can be one."""
    _live: tuple[Document, LiveAlignment, Suggestion | None] | None = field(
        default=None, repr=False
    )

    @property
    def document(self) -> Document:
        """What is annotated now."""
        return self.history.document


@dataclass(frozen=True)
class Outcome:
    """What an action did beside changing the document.

    Parameters
    ----------
    selected : int, optional
        The pair that was placed or changed.
    message : str
        What to tell, such as that the click missed the model.
    """

    selected: int | None = None
    message: str = ""


class Session:
    """All state of an annotator; safe to use from several threads.

    Parameters
    ----------
    model : CadModel
    book : KeypointBook
    slides : sequence of Slide
    keypoints_path : Path
        Where the model's keypoints are written.
    """

    def __init__(
        self, model: CadModel, book: KeypointBook, slides: list[Slide], keypoints_path: Path
    ) -> None:
        self.model = model
        self.book = book
        self.slides = slides
        self.keypoints_path = keypoints_path
        self.wireframe = Wireframe(model)
        self.lock = threading.RLock()
        self._ready = threading.Event()
        self._actions: dict[str, Callable[[Slide, Mapping[str, Any]], Outcome]] = {
            "place_uv": self._place_uv,
            "place_keypoint": self._place_keypoint,
            "pick": self._pick,
            "suggested": self._place_suggested,
            "move": self._move,
            "release": self._release,
            "delete": self._delete,
            "rename": self._rename,
            "focal": self._focal,
            "undo": self._undo,
            "redo": self._redo,
        }

    # --- readiness -------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether the solvers are compiled and loaded, so that a fit takes no time."""
        return self._ready.is_set()

    def warm_up(self) -> None:
        """Have the solvers compiled or loaded, by aligning something, and the model prepared."""
        try:
            problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
            lens = Lens(problem.camera, calibrated=True)
            for known in (True, False):
                align(problem.points_3d, problem.points_2d, None, lens, FocalChoice(known=known))
            # What the first click would wait for: on a model of millions of faces some seconds.
            _ = self.model.scene.caster, self.model.samples
        finally:  # what has failed here fails again, and is said, where it is needed
            self._ready.set()
            with self.lock:
                for slide in self.slides:
                    if slide.fit_waits:
                        self.save(slide)

    # --- what is there ---------------------------------------------------------------------

    def slide(self, number: int) -> Slide:
        """The photo of a number, counted from 0.

        Raises
        ------
        InputError
            If there is none.
        """
        if not 0 <= number < len(self.slides):
            raise InputError(f"there is no photo {number + 1}", where="image")
        return self.slides[number]

    def live(self, slide: Slide) -> tuple[LiveAlignment, Suggestion | None]:
        """The alignment and the best next keypoint of what is annotated now."""
        document = slide.document
        if slide._live is not None and slide._live[0] is document:
            return slide._live[1:]
        if not self.ready:
            return LiveAlignment(message="Solvers and model are being prepared."), None
        pairs = document.complete_pairs
        live = align(
            self.book.xyz(pair.keypoint for pair in pairs if pair.keypoint is not None),
            np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            sigmas_of(pairs),
            slide.lens,
            document.focal,
        )
        suggestion = suggest(self.model, self.book, document.keypoints, live)
        slide._live = (document, live, suggestion)
        return live, suggestion

    # --- actions ---------------------------------------------------------------------------

    def act(self, number: int, action: Mapping[str, Any]) -> Outcome:
        """Do an action on a photo and save what it changed.

        Parameters
        ----------
        number : int
            The photo, counted from 0.
        action : mapping
            ``do``, and what that needs.

        Raises
        ------
        CadalignError
            If the action is unknown, or cannot be done.
        """
        with self.lock:
            slide = self.slide(number)
            name = action.get("do")
            act = self._actions.get(name) if isinstance(name, str) else None
            if act is None:
                raise InputError(
                    f"{name!r} is not an action",
                    where="do",
                    fix=f"known are {', '.join(self._actions)}",
                )
            before = slide.document
            outcome = act(slide, action)
            if slide.document is not before or name == "rename":
                self.save(slide)
            return outcome

    def save(self, slide: Slide) -> None:
        """Write the files of a photo, and those of the model; trouble is kept to be shown."""
        document = slide.document
        ready = self.ready  # asked first: it may become so at any time
        slide.fit_waits = not ready
        live, _ = self.live(slide)
        # What needed assumptions is shown, but not written: `cadalign fit` would refuse it.
        result = None if live.provisional else live.result
        used = frozenset[int]().union(*(other.document.keypoints for other in self.slides))
        try:
            # First the keypoints, which the observation names.
            write_keypoints(self.keypoints_path, self.book, used, slide.sheet.model)
            slide.sheet.write(document, self.book, slide.lens.to_write(document.focal))
            if ready:
                slide.sheet.write_fit(result)
        except CadalignError as error:
            slide.trouble = str(error)
        else:
            slide.trouble = ""
            slide.saved_at = time.time()

    def _place_uv(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        uv = self._uv(slide, action)
        document, pair = slide.document.place_uv(uv, self._optional(action, "pair"))
        slide.history.record(document)
        return Outcome(pair)

    def _place_keypoint(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        keypoint = self._index(action, "keypoint")
        self.book[keypoint]
        return self._place(slide, keypoint, action)

    def _pick(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        """Place a model point by a ray; a keypoint near the click is taken if it can be seen."""
        origin = self.model.from_display(self._numbers(action, "origin", 3))
        direction = self._numbers(action, "direction", 3)
        near = self._optional(action, "near")
        if near is not None and self.model.is_seen(origin, self.book[near].xyz):
            return self._place(slide, near, action)
        point = self.model.pick(origin, direction)
        if point is None:
            return Outcome(message="That click missed the model.")
        return self._place(slide, self.book.add(point), action)

    def _place_suggested(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        _, suggestion = self.live(slide)
        if suggestion is None:
            raise InputError("there is none", where="suggestion", fix="place more pairs")
        keypoint = suggestion.point.semantic_id
        return self._place(
            slide, self.book.add(suggestion.point) if keypoint is None else keypoint, action
        )

    def _place(self, slide: Slide, keypoint: int, action: Mapping[str, Any]) -> Outcome:
        document, pair = slide.document.place_keypoint(keypoint, self._optional(action, "pair"))
        slide.history.record(document)
        return Outcome(pair)

    def _move(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        pair = self._index(action, "pair")
        gesture = self._optional(action, "gesture")
        slide.history.record(
            slide.document.move(pair, self._uv(slide, action)),
            step=None if gesture is None else (pair, gesture),
        )
        return Outcome(pair)

    def _release(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        pair = self._index(action, "pair")
        slide.history.record(slide.document.release_keypoint(pair))
        return Outcome(pair)

    def _delete(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        slide.history.record(slide.document.delete(self._index(action, "pair")))
        return Outcome()

    def _rename(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        pair = slide.document.pair(self._index(action, "pair"))
        if pair.keypoint is None:
            raise InputError("this pair has no model point yet", where="pair")
        self.book.rename(pair.keypoint, convert(action.get("name"), Text, where="name"))
        return Outcome(pair.number)

    def _focal(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        known, pixels = action.get("known"), action.get("pixels")
        if not isinstance(known, bool):
            raise InputError(f"{known!r} is neither true nor false", where="known")
        if pixels is not None:
            pixels = float(convert(pixels, Finite, where="pixels"))
            low, high = (bound * slide.photo.width for bound in _FOCAL_RANGE)
            if not low <= pixels <= high:
                raise InputError(
                    f"{pixels:g} px is no focal length of this photo",
                    where="pixels",
                    fix=f"give {low:.0f} to {high:.0f} px",
                )
        slide.history.record(slide.document.choose_focal(FocalChoice(known, pixels)))
        return Outcome()

    def _undo(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        return Outcome(message="" if slide.history.undo() else "There is nothing to undo.")

    def _redo(self, slide: Slide, action: Mapping[str, Any]) -> Outcome:
        return Outcome(message="" if slide.history.redo() else "There is nothing to redo.")

    # --- fields of actions -----------------------------------------------------------------

    def _uv(self, slide: Slide, action: Mapping[str, Any]) -> Pixel:
        u, v = self._numbers(action, "uv", 2)
        if not slide.lens.camera.contains(np.array([[u, v]]))[0]:
            raise InputError(f"({u:.1f}, {v:.1f}) is outside the photo", where="uv")
        return u, v

    @staticmethod
    def _numbers(action: Mapping[str, Any], name: str, count: int) -> tuple[float, ...]:
        numbers: list[float] = convert(action.get(name), list[Finite], where=name)
        if len(numbers) != count:
            raise InputError(f"{len(numbers)} numbers, not {count}", where=name)
        return tuple(numbers)

    @staticmethod
    def _index(action: Mapping[str, Any], name: str) -> int:
        number: int = convert(action.get(name), Index, where=name)
        return number

    @staticmethod
    def _optional(action: Mapping[str, Any], name: str) -> int | None:
        number: int | None = convert(action.get(name), Index | None, where=name)
        return number
