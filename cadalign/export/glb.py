"""Export to GLB (binary glTF 2.0): the textured model, the cameras and the photos.

The first camera is at the origin, looks along -z and has y up. Lengths are in model units. The
model is a node whose transform holds pose and stretch. Every view is a camera node and a rectangle
with the photo behind the object, unlit (KHR_materials_unlit) and visible from the camera's side
only.

A glTF camera has its principal point at the image's centre and no lens distortion. So the camera's
field of view is the smallest one about the principal point that contains the photo: the camera's
image is the photo with a margin on one side. A distorted photo is resampled to a pinhole camera.

trimesh writes buffers, accessors and images. This module writes cameras and materials: trimesh
supports only one camera, with a wrong aspect ratio, no unlit materials, and 8-bit colours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.color import srgb_to_linear

from cadalign.arrays import BoolArray, FloatArray
from cadalign.export.aligned_object import AlignedObject
from cadalign.geometry.alignment import OPENGL_AXES, OPENGL_FLIP, bounds_corners
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Material, Mesh
from cadalign.io.files import write_whole
from cadalign.io.images import ByteImage, read_image

_gltf: Any = trimesh.exchange.gltf  # which has no types
_visual: Any = trimesh.visual
_UNLIT = "KHR_materials_unlit"
_CLAMP_TO_EDGE = 33071  # OpenGL's constant
_OPAQUE = 0.999  # least opacity of an opaque material
_WHITE = (1.0, 1.0, 1.0, 1.0)

_BORDER = 0.5  # from the corner pixel's centre to the image's border [px]
_GROWTH = 2.0  # largest size of the undistorted photo over the photo's, per axis
_ROUND_TRIP = 1e-6  # largest error of distorting and undistorting a pixel
_RIM = 1.5  # width of the border's colours beyond the photo [px]
_BEHIND = 1.5  # depth of the photo, over the depth of the object's farthest corner
_NEAR, _FAR = 1e-3, 10.0  # clipping planes of the cameras, over the depth of the photo


_Node = tuple[str, trimesh.Trimesh, dict[str, Any], FloatArray]
"""Name, mesh, material and pose in the scene."""


class PlacedPhoto(NamedTuple):
    """A photo as a rectangle behind the object."""

    image: ByteImage | None
    """The photo (h, w, 3), without lens distortion."""
    low: FloatArray
    """Top left corner (2,) in normalised image coordinates, x right and y down."""
    high: FloatArray
    """Bottom right corner (2,)."""
    depth: float
    """Depth of the rectangle."""
    pose: FloatArray
    """Pose (4, 4) of the camera, with glTF's axes."""

    @property
    def lens(self) -> dict[str, float]:
        """The glTF camera, whose field of view is centred at the principal point."""
        across, down = np.maximum(np.abs(self.low), np.abs(self.high)).tolist()
        field = {"aspectRatio": across / down, "yfov": 2 * float(np.arctan(down))}
        return field | {"znear": _NEAR * self.depth, "zfar": _FAR * self.depth}

    @property
    def corners(self) -> FloatArray:
        """Top left, bottom left, bottom right and top right corners in glTF's axes, (4, 3)."""
        (left, top), (right, bottom) = self.low, self.high
        rows = [[left, top, 1], [left, bottom, 1], [right, bottom, 1], [right, top, 1]]
        return np.asarray(np.array(rows) * self.depth * OPENGL_AXES)


def write_glb(path: Path, exported: AlignedObject) -> None:
    """Write an aligned object with its cameras and photos; DataError if a photo is unreadable."""
    placing = OPENGL_FLIP @ exported.views[0].cam_from_model.cam_from_model
    photos = [_placed_photo(exported, number) for number in range(len(exported.views))]
    nodes = [
        (f"{exported.name}_{number}", surface, material, placing)
        for number, (surface, material) in enumerate(_parts(exported.mesh))
    ]
    nodes += [
        _photo_node(f"photo_{number}", photo)
        for number, photo in enumerate(photos)
        if photo.image is not None
    ]
    scene = trimesh.Scene()
    for number, (_, surface, _, place) in enumerate(nodes):
        own = str(number)
        scene.add_geometry(surface, geom_name=own, node_name=own, transform=place)

    def complete(tree: dict[str, Any]) -> None:
        _set_materials(tree, {str(row): material for row, (_, _, material, _) in enumerate(nodes)})
        _set_names(tree, {str(row): name for row, (name, *_) in enumerate(nodes)})
        _add_cameras(tree, photos)

    data = _gltf.export_glb(scene, include_normals=False, tree_postprocessor=complete)
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))


def _set_names(tree: dict[str, Any], names: dict[str, str]) -> None:
    """Set the names of nodes and meshes; trimesh would change repeated names."""
    for each in (*tree["nodes"], *tree["meshes"]):
        each["name"] = names.get(each["name"], each["name"])


def _parts(mesh: Mesh) -> Iterator[tuple[trimesh.Trimesh, dict[str, Any]]]:
    """Split a mesh by material; yields the parts and their glTF materials.

    Vertices with several texture coordinates are repeated.
    """
    for number in np.unique(mesh.face_material):
        material, rows = mesh.materials[number], mesh.face_material == number
        corners, texture = mesh.faces[rows].ravel(), material.texture
        keys = corners[:, None]
        if texture is not None and mesh.corner_uv is not None:
            keys = np.column_stack([corners, mesh.corner_uv[rows].reshape(-1, 2)])
        kept, inverse = np.unique(keys, axis=0, return_inverse=True)
        used, faces, colors = kept[:, 0].astype(np.int64), inverse.reshape(-1, 3), None
        if mesh.vertex_colors is not None:  # which take the place of the material's
            own, material = mesh.vertex_colors[used], replace(material, color=_WHITE)
            linear = np.column_stack([srgb_to_linear(own[:, :3]), own[:, 3]])
            colors = np.round(255 * linear).astype(np.uint8)
        look = _gltf_material(material)
        if texture is not None and mesh.corner_uv is not None:
            surface = _textured(mesh.vertices[used], faces, kept[:, 1:], texture)
            if texture.shape[2] == 4 and (texture[..., 3] < 255).any() and "alphaMode" not in look:
                look["alphaMode"] = "MASK"
        else:
            surface = trimesh.Trimesh(
                mesh.vertices[used], faces, vertex_colors=colors, process=False
            )
        yield surface, look


def _textured(vertices: FloatArray, faces: Any, uv: FloatArray, texture: Any) -> trimesh.Trimesh:
    material = _visual.material.PBRMaterial(baseColorTexture=Image.fromarray(texture))
    visual = _visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def _photo_node(name: str, photo: PlacedPhoto) -> _Node:
    uv = np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    mesh = _textured(photo.corners, np.array([[0, 1, 2], [0, 2, 3]]), uv, photo.image)
    material = {
        "name": name,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {_UNLIT: {}},
    }
    return name, mesh, material, photo.pose


def _gltf_material(material: Material) -> dict[str, Any]:
    red, green, blue, alpha = material.color
    look: dict[str, Any] = {
        "name": material.name or "surface",
        "pbrMetallicRoughness": {
            "baseColorFactor": [*srgb_to_linear(np.array([red, green, blue])).tolist(), alpha],
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "doubleSided": True,  # faces of CAD models point either way
    }
    return look | ({"alphaMode": "BLEND"} if alpha < _OPAQUE else {})


def _set_materials(tree: dict[str, Any], looks: dict[str, dict[str, Any]]) -> None:
    """Replace trimesh's materials, keeping their textures."""
    brought = tree.get("materials", [])
    tree["materials"] = []
    for mesh in tree["meshes"]:
        look = looks[mesh["name"]]
        for primitive in mesh["primitives"]:
            surface = dict(look["pbrMetallicRoughness"])
            if "material" in primitive:
                old = brought[primitive["material"]].get("pbrMetallicRoughness", {})
                if "baseColorTexture" in old:
                    surface["baseColorTexture"] = old["baseColorTexture"]
                    if _UNLIT in look.get("extensions", {}):
                        tree["textures"][old["baseColorTexture"]["index"]]["sampler"] = 0
            primitive["material"] = len(tree["materials"])
            tree["materials"].append({**look, "pbrMetallicRoughness": surface})
    if any(_UNLIT in look.get("extensions", {}) for look in looks.values()):
        # By default a texture repeats: the photo's opposite borders would mix.
        tree["samplers"] = [{"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}]
        tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), _UNLIT})


def _add_cameras(tree: dict[str, Any], photos: Sequence[PlacedPhoto]) -> None:
    tree["cameras"] = []
    roots = tree["scenes"][tree["scene"]]["nodes"]
    for number, photo in enumerate(photos):
        name = f"camera_{number}"
        tree["cameras"].append({"name": name, "type": "perspective", "perspective": photo.lens})
        roots.append(len(tree["nodes"]))
        matrix = photo.pose.T.ravel().tolist()
        tree["nodes"].append({"name": name, "camera": number, "matrix": matrix})


def _placed_photo(exported: AlignedObject, number: int) -> PlacedPhoto:
    """Place a view's photo behind the object's farthest corner."""
    view = exported.views[number]
    image = None if view.image is None else read_image(view.image, view.camera)
    pose = OPENGL_FLIP @ exported.first_from_cam(number) @ OPENGL_FLIP
    corners = view.cam_from_model.apply(bounds_corners(*exported.mesh.bounds))
    depth = _BEHIND * float(np.abs(corners[:, 2]).max())
    return PlacedPhoto(*photo_plane(view.camera, image), depth, pose)


def photo_plane(
    camera: Camera, image: ByteImage | None
) -> tuple[ByteImage | None, FloatArray, FloatArray]:
    """Undistort a camera's photo; returns it and its corners at depth 1, see `PlacedPhoto`."""
    if camera.distortion:
        pinhole = _pinhole_of(camera)
        image = None if image is None else _undistort(image, camera, pinhole)
        camera = pinhole
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    size = np.array([camera.width, camera.height])
    return image, (-_BORDER - centre) / focal, (size - _BORDER - centre) / focal


def _pinhole_of(camera: Camera) -> Camera:
    """Pinhole camera of the same focal length that contains the photo, within `_GROWTH`."""
    width, height = camera.width, camera.height
    across, down = np.arange(width + 1) - _BORDER, np.arange(height + 1) - _BORDER
    sides = [np.stack([across, np.full(width + 1, y)], axis=1) for y in (down[0], down[-1])]
    sides += [np.stack([np.full(height + 1, x), down], axis=1) for x in (across[0], across[-1])]
    normalized, valid = camera.normalize_where_valid(np.concatenate(sides))
    pixels = normalized[valid] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    whole = np.array([[-_BORDER] * 2, [width - _BORDER, height - _BORDER]])
    pixels = pixels if len(pixels) else whole
    slack = (_GROWTH - 1) * np.array([width, height])
    low = np.maximum(np.floor(pixels.min(axis=0) + _BORDER), -slack)
    high = np.minimum(np.ceil(pixels.max(axis=0) + _BORDER), [width, height] + slack)
    columns, rows = (int(n) for n in np.maximum(high - low, 1))
    cx, cy = camera.cx - float(low[0]), camera.cy - float(low[1])
    return Camera(columns, rows, camera.fx, camera.fy, cx, cy)


def _undistort(image: ByteImage, camera: Camera, pinhole: Camera) -> ByteImage:
    """Resample the photo to the pinhole camera, black outside the photo."""
    columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    targets = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    normalized = pinhole.normalize(targets)
    sources = camera.pixels_from_normalized(normalized)
    # Where the lens model is not invertible, distant pixels would project into the photo.
    inside: BoolArray = np.asarray(np.isfinite(sources).all(axis=1))
    inside[inside] = camera.contains(sources[inside], margin=-_RIM)
    back, valid = camera.normalize_where_valid(sources[inside])
    gap = np.abs(back - normalized[inside]).max(axis=1, initial=0.0)
    inside[inside] = valid & (gap < _ROUND_TRIP)
    sources[~inside] = -10.0
    maps = sources.reshape(pinhole.height, pinhole.width, 2).astype(np.float32)
    # Pixels beyond the border repeat its colour, since viewers would mix black into it.
    drawn = cv2.remap(
        image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    drawn[~inside.reshape(drawn.shape[:2])] = 0
    return np.asarray(drawn, dtype=np.uint8)
