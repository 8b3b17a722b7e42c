"""Sample models: parts, joined to one mesh with keypoints on its surface."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sample.parts import Place, has_area
from cadalign.geometry.mesh import Mesh, join


class Kind(SimpleNamespace):
    """Measures of a kind of object, by their names."""

    def varied(self, rng: np.random.Generator, **factors: tuple[float, float]) -> Kind:
        """A copy, some of its measures multiplied by factors drawn between two."""
        drawn = {name: getattr(self, name) * rng.uniform(*two) for name, two in factors.items()}
        return Kind(**vars(self) | drawn)


def table(text: str) -> list[Kind]:
    """Kinds by the rows of a table, at whose head stand the names of numbers and words."""
    names, *rows = (line.split() for line in text.strip().splitlines())
    cells = ((float(cell) if cell[-1].isdigit() else cell for cell in row) for row in rows)
    return [Kind(**dict(zip(names, row, strict=True))) for row in cells]


@dataclass
class Draft:
    """A model that is being built, in its builder's units, y up and the front at -z."""

    parts: list[Mesh] = field(default_factory=list)
    # By semantic id: keypoints land on the surface's nearest point.
    places: dict[int, Place] = field(default_factory=dict)
    # Semantic ids that a mirror plane exchanges, and that a rotation about y permutes.
    mirrored: list[tuple[int, int]] = field(default_factory=list)
    turned: list[tuple[int, ...]] = field(default_factory=list)
    # Any rotation about y is one: each group that is turned lies on a circle.
    round: bool = False

    def add(self, *parts: Mesh) -> None:
        self.parts += parts

    def add_pair(self, *parts: Mesh) -> None:
        """Add parts and their mirror images under x -> -x."""
        for right in parts:
            vertices, faces = right.vertices * (-1, 1, 1), right.faces[:, ::-1]
            self.parts += [right, replace(right, vertices=vertices, faces=faces)]

    def mark_pair(self, right: int, left: int, place: Place) -> None:
        """Set the places of two semantic ids: the given one and its mirror image."""
        x, y, z = place
        self.places |= {right: (x, y, z), left: (-x, y, z)}
        self.mirrored.append((right, left))


@dataclass(frozen=True, eq=False)
class SampleKeypoint:
    """A keypoint on the surface."""

    semantic_id: int
    xyz: FloatArray  # (3,) [model units]
    face_index: int
    barycentric: FloatArray  # (3,) weights of the face's corners, of sum 1
    vertex_index: int  # of the nearest vertex


@dataclass(frozen=True, eq=False)
class SampleModel:
    """A finished model: the diagonal of its bounding box is 1, the front is at -z."""

    category: str
    model_id: str
    mesh: Mesh  # with vertex colours; coordinates are exact in single precision
    keypoints: tuple[SampleKeypoint, ...]  # ordered by semantic id
    mirrored: tuple[tuple[int, int], ...]  # as of its `Draft`
    turned: tuple[tuple[int, ...], ...]
    round: bool


def finish(draft: Draft, category: str, model_id: str, offset: FloatArray) -> SampleModel:
    """Join the parts, scale them to a box of diagonal 1 about ``offset`` (3,), set keypoints."""
    whole = join(draft.parts, f"{category} {model_id}")
    center, diagonal = whole.bounds.mean(axis=0), np.linalg.norm(np.ptp(whole.bounds, axis=0))
    # The file holds single precision: the mesh and what is computed from it agree with that.
    scaled = ((whole.vertices - center) / diagonal + offset).astype(np.float32).astype(np.float64)
    faces = whole.faces[has_area(scaled[whole.faces])]  # rounding flattens some
    mesh = Mesh(scaled, faces, vertex_colors=whole.vertex_colors, source=whole.source)
    ids = sorted(draft.places)
    places = (np.array([draft.places[number] for number in ids]) - center) / diagonal + offset
    face_index, weights = mesh.closest(places)
    xyz = mesh.surface_points(face_index, weights)
    vertex = [int(np.argmin(np.linalg.norm(scaled - point, axis=1))) for point in xyz]
    keypoints = tuple(map(SampleKeypoint, ids, xyz, face_index.tolist(), weights, vertex))
    symmetries = tuple(draft.mirrored), tuple(draft.turned), draft.round
    return SampleModel(category, model_id, mesh, keypoints, *symmetries)
