"""The forms of data sets, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from cadalign.errors import DataError, InputError, quote
from cadalign.export.photo_sets.annotated import AnnotatedPhoto
from cadalign.export.photo_sets.bop import write_bop
from cadalign.export.photo_sets.kitti import write_kitti
from cadalign.export.photo_sets.objectron import write_objectron
from cadalign.export.photo_sets.pix3d import write_pix3d
from cadalign.export.photo_sets.scan2cad import write_scan2cad_set
from cadalign.io.files import writing

FORMS: dict[str, Callable[[Path, Iterable[tuple[int, AnnotatedPhoto]]], list[InputError]]] = {
    "pix3d": write_pix3d,
    "bop": write_bop,
    "scan2cad": write_scan2cad_set,
    "kitti": write_kitti,
    "objectron": write_objectron,
}
"""Writers by the names of their forms."""


def write_photo_set(
    folder: Path, photos: Sequence[AnnotatedPhoto], form: str
) -> tuple[InputError, ...]:
    """Write annotated photos as a data set that `cadalign.datasets.open` reads.

    Poses, keypoints, cameras and photos are read back as they were given, and masks where the form
    has them. Forms without a stretch (Pix3D, BOP) have the stretched mesh as the model; KITTI has
    boxes that stand upright alone; Objectron the model's box in place of the model.

    Parameters
    ----------
    folder : Path
        A new or empty folder.
    photos : sequence of AnnotatedPhoto
    form : str
        One of `FORMS`.

    Returns
    -------
    tuple of InputError
        Why some of the photos were left out: the form cannot hold them.

    Raises
    ------
    InputError
        If the form is unknown, or there is no photo that it can hold.
    DataError
        If the folder has files, or cannot be written to.
    """
    if form not in FORMS:
        raise InputError(
            f"unknown form {quote(form)}", where="form", fix=f"known are {', '.join(FORMS)}"
        )
    if not photos:
        raise InputError(
            "no photo has an alignment yet", where="export", fix="place at least four pairs"
        )
    with writing(folder):
        if folder.exists() and any(folder.iterdir()):
            raise DataError("the folder is not empty", where=str(folder), fix="give a new one")
        folder.mkdir(parents=True, exist_ok=True)
    problems = FORMS[form](folder, enumerate(photos))
    if len(problems) == len(photos):
        raise problems[0]
    return tuple(problems)
