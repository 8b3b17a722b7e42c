"""CAD model in the annotator: exact points on its mesh that clicks go to, and its display."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cadalign.annotate.files import LastContent, keypoints_file, refuse_other_model
from cadalign.annotate.keypoints import KeypointRegistry, ObjectShape
from cadalign.annotate.marks import Pair
from cadalign.annotate.wireframe import Wireframe
from cadalign.arrays import FloatArray, as_floats
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import InputError
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import FaceArray
from cadalign.geometry.simplify import simplify
from cadalign.io.files import require_utf8
from cadalign.io.meshes.files import load_mesh
from cadalign.render.raycast.surface import coincident_faces
from cadalign.render.scene import Scene

_MOST_FACES = 150_000  # that are displayed
# Depth beneath the surface at which markers can still be clicked [diagonals]: keypoints sit in
# corners, where rays to them graze other parts. The page uses the same value.
_BENEATH = 0.02
_SAME_PLACE = 1e-6  # largest distance of two points that count as one [diagonals]


class ClickableModel:
    """A mesh that can be clicked on; centre and diagonal are its box's [model units]."""

    def __init__(self, mesh: Mesh) -> None:
        self.scene = Scene(mesh)
        low, high = self.scene.bounds
        self.center: FloatArray = (low + high) / 2
        self.diagonal = self.scene.diagonal
        if not self.diagonal > 0:
            raise InputError("all vertices of the mesh coincide", where=mesh.source)

    @cached_property
    def wireframe(self) -> Wireframe:
        """The lines of the model."""
        return Wireframe.of_scene(self.scene)

    def to_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn model coordinates (..., 3) into the page's: centred, with a diagonal of 1."""
        return np.asarray((np.asarray(xyz, dtype=float) - self.center) / self.diagonal)

    def from_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn the page's coordinates (..., 3) into model coordinates."""
        return np.asarray(np.asarray(xyz, dtype=float) * self.diagonal + self.center)

    def pick(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> ModelKeypoint | None:
        """Intersect a ray, in model coordinates, with the surface; None if it misses."""
        start = as_floats(origin, name="origin", shape=(3,))
        along = as_floats(direction, name="direction", shape=(3,))
        if not along.any():
            raise InputError("the vector is zero", where="direction")
        face, distance = self.scene.caster.first_hits(start, along[None])
        if face[0] < 0 or not np.isfinite(distance[0]):
            return None
        x, y, z = (start + distance[0] * along).tolist()
        return ModelKeypoint(name="", xyz=(x, y, z))

    def is_seen(self, origin: npt.ArrayLike, xyz: npt.ArrayLike) -> bool:
        """True if a point on the surface, or slightly beneath it, is visible from ``origin``."""
        start = as_floats(origin, name="origin", shape=(3,))
        sight = as_floats(xyz, name="xyz", shape=(3,)) - start
        length = float(np.linalg.norm(sight))
        if not length > 0:
            return True
        _, distance = self.scene.caster.first_hits(start, sight[None])
        return bool(distance[0] >= 1 - _BENEATH * self.diagonal / length)

    @cached_property
    def display_bytes(self) -> bytes:
        """The model for display, simplified to at most 150,000 triangles.

        The numbers of faces and of creases (uint32); positions (faces, 3, 3), normals (faces, 3, 3)
        and linear colours (faces, 3, 3) of corners, and creases (k, 2, 3), all float32,
        little-endian, in display coordinates. Of triangles in one place one is shown.
        """
        small = simplify(self.scene.mesh, max_faces=_MOST_FACES)
        alike, opposite = coincident_faces(small.vertices, small.faces)
        first = np.flatnonzero(np.minimum(alike, opposite) == np.arange(len(alike)))
        triangles: FaceArray = small.source[first].astype(np.int32)
        weights = np.full((len(first), 3), 1 / 3, dtype=np.float32)
        color = self.scene.surface.color(triangles, weights)[:, None, :3]
        shown = Mesh(self.to_display(small.vertices), small.faces[first])
        creases = self.to_display(self.wireframe.creases)
        arrays = (
            shown.triangles,
            Scene(shown).corner_normals,
            np.broadcast_to(color, (len(first), 3, 3)),
            creases,
        )
        counts = np.array([len(first), len(creases)], dtype="<u4")
        return counts.tobytes() + b"".join(each.astype("<f4").tobytes() for each in arrays)


@dataclass(eq=False)
class OpenedModel:
    """A model that can be clicked on, its keypoints, and the file they are written to."""

    path: Path
    cad: ClickableModel
    registry: KeypointRegistry
    keypoints_path: Path
    content: LastContent  # of that file

    def points_of(self, pairs: Iterable[Pair]) -> list[ModelKeypoint]:
        """The model points of pairs that have one."""
        return [self.registry[pair.keypoint] for pair in pairs if pair.keypoint is not None]

    def write_keypoints(self, used: frozenset[int]) -> None:
        """Write the given keypoints and those in use; raises DataError on failure."""
        registry = self.registry
        self.content.refuse_changed(self.keypoints_path)
        kept = (point for number, point in registry if number in registry.given | used)
        ModelKeypoints(tuple(kept), self.path).save(self.keypoints_path)
        self.content.note(self.keypoints_path)


def open_model(
    path: Path, folder: Path, *, keypoints: Path | None = None, shape: ObjectShape
) -> OpenedModel:
    """Open a model, whose keypoints are written into a folder.

    ``keypoints`` are those given with it, where they are not beside it. New ones don't get the ids
    of the shape's.
    """
    require_utf8(path)
    cad = ClickableModel(load_mesh(path))
    own, content = keypoints_file(path, folder), LastContent()
    content.note(own)
    reserved = (label for label in shape.ids if isinstance(label, int))
    registry = KeypointRegistry(reserved=reserved, tolerance=_SAME_PLACE * cad.diagonal)
    for source in dict.fromkeys((keypoints or keypoints_file(path, path.parent), own)):
        if source == keypoints or source.exists():
            read = ModelKeypoints.load(source, model=path)
            if source == own:
                refuse_other_model(read.model, path, where=own)
            registry.merge(read.keypoints)
    return OpenedModel(path, cad, registry, own, content)
