"""The declared parts of a glTF 2.0 document that a mesh needs.

After the Khronos Group's specification of glTF 2.0 and of the extensions that are named.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, field

from cadalign.io.documents import Count, Finite, ForeignDocument, Point2, Point3

_Point4 = tuple[Finite, Finite, Finite, Finite]


class _Part(ForeignDocument, rename="camel", kw_only=True):
    """Base of the document's parts."""


class Asset(_Part):
    """Statements of the file about itself."""

    version: str = "2.0"


class GltfScene(_Part):
    """The roots of a scene's trees of nodes."""

    nodes: list[Count] = field(default_factory=list)


class Node(_Part):
    """A node, placed by a matrix (by columns) or by scale, rotation (x, y, z, w), translation."""

    mesh: Count | None = None
    children: list[Count] = field(default_factory=list)
    matrix: Annotated[list[Finite], Meta(min_length=16, max_length=16)] | None = None
    translation: Point3 = (0.0, 0.0, 0.0)
    rotation: _Point4 = (0.0, 0.0, 0.0, 1.0)
    scale: Point3 = (1.0, 1.0, 1.0)


class Primitive(_Part):
    """A part of a mesh with one material; attributes and indices are numbers of accessors."""

    attributes: dict[str, Count]
    indices: Count | None = None
    material: Count | None = None
    mode: int = 4


class GltfMesh(_Part):
    """The primitives of a mesh."""

    primitives: list[Primitive]


class SparseIndices(_Part):
    """Places at which a sparse accessor has values of its own."""

    buffer_view: Count
    component_type: int
    byte_offset: Count = 0


class SparseValues(_Part):
    """The values of a sparse accessor."""

    buffer_view: Count
    byte_offset: Count = 0


class Sparse(_Part):
    """Values that a sparse accessor changes."""

    count: Count
    indices: SparseIndices
    values: SparseValues


class Accessor(_Part):
    """An array in a buffer."""

    count: Count
    component_type: int
    type: str
    buffer_view: Count | None = None
    byte_offset: Count = 0
    normalized: bool = False
    sparse: Sparse | None = None


class BufferView(_Part):
    """A part of a buffer."""

    buffer: Count
    byte_length: Count
    byte_offset: Count = 0
    byte_stride: Count | None = None


class Buffer(_Part):
    """Bytes: a file, data in the text, or the binary part of a GLB file."""

    byte_length: Count
    uri: str | None = None


class Image(_Part):
    """A picture: a file, data in the text, or a part of a buffer."""

    uri: str | None = None
    buffer_view: Count | None = None


class WebpSource(_Part):
    """A texture's picture, where it is WebP."""

    source: Count | None = None


class TextureExtensions(_Part):
    """The extensions of textures that are read."""

    webp: WebpSource = field(name="EXT_texture_webp", default_factory=WebpSource)


class Texture(_Part):
    """The picture of a texture."""

    source: Count | None = None
    extensions: TextureExtensions = field(default_factory=TextureExtensions)


class TextureTransform(_Part):
    """Change of texture coordinates: scaled, rotated [rad], moved."""

    offset: Point2 = (0.0, 0.0)
    rotation: Finite = 0.0
    scale: Point2 = (1.0, 1.0)
    tex_coord: Count | None = None


class UseExtensions(_Part):
    """The extensions of a texture's use that are read."""

    transform: TextureTransform | None = field(name="KHR_texture_transform", default=None)


class TextureUse(_Part):
    """A texture as a material uses it, with the number of its set of coordinates."""

    index: Count
    tex_coord: Count = 0
    extensions: UseExtensions = field(default_factory=UseExtensions)


class Metallic(_Part):
    """The base colour of a material, in linear light."""

    base_color_factor: _Point4 | None = None
    base_color_texture: TextureUse | None = None


class Glossiness(_Part):
    """The base colour of a material as an older extension has it."""

    diffuse_factor: _Point4 | None = None
    diffuse_texture: TextureUse | None = None


class MaterialExtensions(_Part):
    """The extensions of materials that are read."""

    glossiness: Glossiness | None = field(name="KHR_materials_pbrSpecularGlossiness", default=None)


class MaterialPart(_Part):
    """The look of a surface."""

    name: str = ""
    pbr_metallic_roughness: Metallic = field(default_factory=Metallic)
    extensions: MaterialExtensions = field(default_factory=MaterialExtensions)


class GltfDocument(_Part):
    """The whole document."""

    asset: Asset = field(default_factory=Asset)
    scene: Count = 0
    scenes: list[GltfScene] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)
    meshes: list[GltfMesh] = field(default_factory=list)
    accessors: list[Accessor] = field(default_factory=list)
    buffer_views: list[BufferView] = field(default_factory=list)
    buffers: list[Buffer] = field(default_factory=list)
    materials: list[MaterialPart] = field(default_factory=list)
    textures: list[Texture] = field(default_factory=list)
    images: list[Image] = field(default_factory=list)
    extensions_required: list[str] = field(default_factory=list)
