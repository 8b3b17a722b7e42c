"""USD: the textured model, the cameras, and behind it the photos.

The scene is as `cadalign.export.glb` lays it out. A camera has the field of view that holds its
photo, about the principal point. Pixar's library is an extra: ``pip install 'cadalign[usd]'``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.export.aligned_object import AlignedObject, Frame
from cadalign.export.scene_parts import OPAQUE, PlacedPhoto, parts_of, placed_parts
from cadalign.geometry.box import extent
from cadalign.io.files import refuse_folder, write_whole
from cadalign.io.images import ByteImage, write_image

if TYPE_CHECKING:
    from pxr import Usd

INSTALL = "pip install 'cadalign[usd]'   (or: pip install usd-core)"
_APERTURE = 36.0  # width of the film; USD counts it in tenths of the scene's unit


@dataclass(frozen=True, eq=False)
class _Surface:
    """A mesh with its look; ``texture`` is the name of an image file beside the scene's."""

    name: str
    vertices: FloatArray
    faces: IntArray
    uv: FloatArray | None
    color: tuple[float, ...]
    texture: str | None
    colors: FloatArray | None = None
    is_photo: bool = False
    is_cut_out: bool = False


def write_usd(path: Path, exported: AlignedObject, *, frame: Frame = "camera") -> None:
    """Write an aligned object as ``.usdz`` (one file), or ``.usda``, ``.usdc``, ``.usd``.

    Textures of the latter are PNG files beside the file.

    Raises
    ------
    InputError
        If there is no mesh, the frame is not known, or USD's library is missing.
    DataError
        If a photo cannot be read.
    """
    _require_library()
    refuse_folder(path)
    if path.suffix != ".usdz":
        _write_stage(path, exported, frame)
        return
    from pxr import UsdUtils

    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder, f"{path.stem}.usdc")
        _write_stage(scene, exported, frame)
        package = Path(folder, "package.usdz")
        UsdUtils.CreateNewUsdzPackage(str(scene), str(package))
        data = package.read_bytes()
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))


def _require_library() -> None:
    try:
        import pxr  # noqa: F401
    except ImportError:
        what = "USD's library is not installed"
        raise InputError(what, where="format", fix=INSTALL) from None


def _write_stage(path: Path, exported: AlignedObject, frame: Frame) -> None:
    from pxr import Usd, UsdGeom

    mesh, placing, photos = placed_parts(exported, frame)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
    _place(UsdGeom.Xform.Define(stage, "/scene/model"), placing)
    for number, part in enumerate(parts_of(mesh)):
        texture = None
        if part.uv is not None and part.material.texture is not None:
            texture = _write_texture(path, f"texture_{number}", part.material.texture)
        shape, color = (part.vertices, part.faces, part.uv), part.material.color
        colors = part.colors if texture is None else None
        surface = _Surface(f"model/part_{number}", *shape, color, texture, colors)
        _add_surface(stage, replace(surface, is_cut_out=part.is_cut_out))
    for number, photo in enumerate(photos):
        view, plane = f"view_{number}", photo.plane
        _place(UsdGeom.Xform.Define(stage, f"/scene/{view}"), photo.pose)
        _add_camera(stage, f"/scene/{view}/camera", photo)
        if plane.image is not None:
            texture = _write_texture(path, f"photo_{number}", plane.image)
            rectangle = plane.rectangle(photo.depth)
            black = (0, 0, 0, 1)
            _add_surface(
                stage, _Surface(f"{view}/photo", *rectangle, black, texture, is_photo=True)
            )
    write_whole(path, lambda unfinished: stage.GetRootLayer().Export(str(unfinished)))


def _write_texture(path: Path, name: str, image: ByteImage) -> str:
    target = path.with_name(f"{path.stem}_{name}.png")
    write_image(target, image)
    return target.name


def _place(xform: Any, matrix: FloatArray) -> None:
    from pxr import Gf

    xform.AddTransformOp().Set(Gf.Matrix4d(matrix.T.tolist()))  # rows are columns in USD


def _add_camera(stage: Usd.Stage, place: str, photo: PlacedPhoto) -> None:
    from pxr import Gf, UsdGeom

    camera = UsdGeom.Camera.Define(stage, place)
    across, down = photo.plane.half_field.tolist()
    camera.GetFocalLengthAttr().Set(_APERTURE / (2 * across))
    camera.GetHorizontalApertureAttr().Set(_APERTURE)
    camera.GetVerticalApertureAttr().Set(_APERTURE * down / across)
    camera.GetClippingRangeAttr().Set(Gf.Vec2f(*photo.clipping))


def _add_surface(stage: Usd.Stage, surface: _Surface) -> None:
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    place = f"/scene/{surface.name}"
    mesh = UsdGeom.Mesh.Define(stage, place)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(surface.vertices.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.faces), 3, np.int32)))
    corners = surface.faces.ravel().astype(np.int32)
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(not surface.is_photo)
    bounds = extent(surface.vertices).astype(np.float32)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(bounds))
    if surface.uv is not None:
        primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
        )
        primvar.Set(Vt.Vec2fArray.FromNumpy(surface.uv.astype(np.float32)))
    if surface.colors is not None:
        primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
        )
        shown = [_linear(color) for color in surface.colors]
        primvar.Set(Vt.Vec3fArray(shown))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_add_material(stage, place, surface))


def _add_material(stage: Usd.Stage, place: str, surface: _Surface) -> Any:
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, f"{place}/material")
    shader = UsdShade.Shader.Define(stage, f"{place}/material/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", types.Float).Set(1.0)
    shader.CreateInput("opacity", types.Float).Set(float(surface.color[3]))
    color = shader.CreateInput("diffuseColor", types.Color3f)
    color.Set(_linear(surface.color))
    if surface.texture is not None:
        picture = _add_texture(stage, f"{place}/material", surface)
        target = color
        if surface.is_photo:  # it shines by itself
            target = shader.CreateInput("emissiveColor", types.Color3f)
        target.ConnectToSource(picture, "rgb")
        if surface.is_cut_out:
            shader.GetInput("opacity").ConnectToSource(picture, "a")
            if surface.color[3] >= OPAQUE:  # as glTF's MASK, or the parts behind shine through
                shader.CreateInput("opacityThreshold", types.Float).Set(0.5)
    elif surface.colors is not None:
        reader = UsdShade.Shader.Define(stage, f"{place}/material/colors")
        reader.CreateIdAttr("UsdPrimvarReader_float3")
        reader.CreateInput("varname", types.String).Set("displayColor")
        reader.CreateOutput("result", types.Float3)
        color.ConnectToSource(reader.ConnectableAPI(), "result")
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def _linear(color: Sequence[float] | FloatArray) -> Any:
    """A colour as USD has it, in linear light."""
    from pxr import Gf

    return Gf.ConvertDisplayToLinear(Gf.Vec3f(*(float(value) for value in color[:3])))


def _add_texture(stage: Usd.Stage, place: str, surface: _Surface) -> Any:
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    reader = UsdShade.Shader.Define(stage, f"{place}/uv")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    picture = UsdShade.Shader.Define(stage, f"{place}/texture")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", types.Asset).Set(f"./{surface.texture}")
    if not surface.is_photo:  # the material's colour multiplies with the texture
        scale = Gf.Vec4f(*_linear(surface.color), float(surface.color[3]))
        picture.CreateInput("scale", types.Float4).Set(scale)
    picture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    for axis in ("wrapS", "wrapT"):
        picture.CreateInput(axis, types.Token).Set("clamp" if surface.is_photo else "repeat")
    picture.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    picture.CreateOutput("rgb", types.Float3)
    picture.CreateOutput("a", types.Float)
    return picture.ConnectableAPI()
