"""Library of models that a session's models are chosen from."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import Image

from cadalign.annotate.names import named_model, observation_file
from cadalign.annotate.options import FileOptions
from cadalign.annotate.photos import find_photos
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.datasets.models.shapenet import require_category
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera
from cadalign.render import RaycastRenderer, Scene
from cadalign.render.drawing.pictures import Angles, pose_in_view
from cadalign.retrieval import Library, LibraryModel
from cadalign.retrieval.models import ModelKey

_THUMBNAIL = (180, 135)  # [px]
_GREY = (185, 189, 196)
# ShapeNet's models face -z, with y up: seen from the front, the left and above.
_SEEN_FROM = Angles(azimuth=150.0, elevation=20.0)


@dataclass(frozen=True, eq=False)
class ModelChoice:
    """A library of models, of which the session's is one, or one category of it."""

    library: Library
    category: str | None = None  # name of the only category to choose from

    @classmethod
    def open(cls, options: FileOptions) -> ModelChoice | None:
        """Open the library that the options name; None without one. Raises a CadalignError."""
        if options.library is None:
            if options.category is not None:
                raise InputError(
                    "names a category of a library, but none is given",
                    where="--category",
                    fix="give --library",
                )
            return None
        library = Library.open(options.library)
        if options.category is None:
            return cls(library)
        category = require_category(options.category, library.categories, where="--category")
        return cls(library, category)

    @cached_property
    def keys(self) -> tuple[ModelKey, ...]:
        """Category and model id of all models to choose from, sorted."""
        return tuple(
            key for key in self.library.keys if self.category is None or key[0] == self.category
        )

    @cached_property
    def ids(self) -> frozenset[int]:
        """Semantic ids of the models' keypoints."""
        return frozenset(number for key in self.keys for number in self.library[key].ids.tolist())

    def model(self, key: ModelKey) -> LibraryModel:
        """Find a model that can be chosen; raises InputError if there is none with a mesh."""
        if key not in self.keys:
            raise InputError(f"there is no model {key[1]!r} of {key[0]!r}", where="library")
        model = self.library[key]
        if model.mesh_path is None:
            raise InputError(
                f"the model {key[1]!r} has no mesh", where="library", fix="choose another model"
            )
        return model

    def key_of(self, mesh: Path) -> ModelKey | None:
        """The key of the model of a mesh file; None if the library has none."""
        return self._keys_by_mesh.get(mesh.resolve())

    def ids_on(self, mesh: Path) -> frozenset[int]:
        """Semantic ids that are the library's on a mesh: all of them on one of another source."""
        key = self.key_of(mesh)
        if key is None:
            return self.ids
        return frozenset(self.library[key].ids.tolist())

    def keypoints_of(self, mesh: Path) -> tuple[ModelKeypoint, ...]:
        """The keypoints that the library has for a mesh file; none for another file."""
        key = self.key_of(mesh)
        if key is None:
            return ()
        model = self.library[key]
        return tuple(
            ModelKeypoint(f"keypoint {number}", (x, y, z), number)
            for number, (x, y, z) in zip(model.ids.tolist(), model.xyz.tolist(), strict=True)
        )

    @cached_property
    def _keys_by_mesh(self) -> dict[Path, ModelKey]:
        return {
            path.resolve(): key
            for key in self.keys
            if (path := self.library[key].mesh_path) is not None
        }


def starting_model(options: FileOptions, image: Path) -> Path:
    """The model of a session for which only a library is given.

    The model of an earlier session, else the one with the most keypoints. Raises a CadalignError.
    """
    choice = ModelChoice.open(options)
    if choice is None:
        raise InputError("no model is given", where="--model", fix="give one, or a --library")
    photos = find_photos(image)
    out = options.out or photos[0].parent
    given = options.observation
    for path in (observation_file(photo, out) for photo in photos) if given is None else [given]:
        mesh = named_model(path)
        if mesh is not None and choice.key_of(mesh) is not None:
            return mesh
    models = [choice.library[key] for key in choice.keys]
    having = [(len(model.ids), model.mesh_path) for model in models if model.mesh_path is not None]
    if not having:
        raise InputError("none of its models has a mesh", where="--library")
    return max(having, key=lambda each: each[0])[1]  # the first of several


def thumbnail_of(choice: ModelChoice, number: int) -> bytes:
    """Draw the model of a number among `ModelChoice.keys`, as a small JPEG."""
    if not 0 <= number < len(choice.keys):
        number = 0
    scene = Scene(choice.model(choice.keys[number]).load_mesh())
    camera = Camera.from_fov(*_THUMBNAIL, fov_x=30.0)
    frame = RaycastRenderer().render(scene, camera, pose_in_view(scene, camera, _SEEN_FROM))
    background = np.full((camera.height, camera.width, 3), _GREY, dtype=np.uint8)
    data = io.BytesIO()
    Image.fromarray(frame.composite(background)).save(data, "JPEG", quality=85)
    return data.getvalue()
