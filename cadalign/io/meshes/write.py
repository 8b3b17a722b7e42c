"""Meshes as OBJ, with materials and textures, and as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Mesh, spread_colors
from cadalign.io.files import made_folder, write_text, write_whole
from cadalign.io.images import write_image


def write_obj_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh as OBJ, with its materials as MTL and PNG beside it; folders are made.

    Faces keep their order and polygons their corners' texture coordinates; vertex colours follow
    the coordinates, as MeshLab reads them.

    Raises DataError if a file cannot be written.
    """
    made_folder(path.parent)
    library = path.with_suffix(".mtl")
    names = [f"material_{number}" for number in range(len(mesh.materials))]
    lines = [f"mtllib {library.name}", *_vertex_lines(mesh)]
    uv_rows = None
    if mesh.corner_uv is not None and any(each.texture is not None for each in mesh.materials):
        distinct, rows = np.unique(mesh.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        uv_rows = rows.reshape(-1, 3) + 1
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in distinct.tolist()]
    lines += _face_lines(mesh, names, uv_rows)
    write_text(library, "\n".join(_material_lines(mesh, names, path)) + "\n")
    write_text(path, "\n".join(lines) + "\n")


def write_ply_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary PLY, its faces in their order, with colours of its vertices.

    A surface without vertex colours has its materials'; PLY has no textures. Folders are made.

    Raises DataError if the file cannot be written.
    """
    import trimesh  # takes long to import, which OBJ files need not

    made_folder(path.parent)
    colors = np.round(255 * spread_colors(mesh, _palette(mesh))).astype(np.uint8)
    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    data = trimesh.exchange.ply.export_ply(plain, vertex_normal=False)
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))


def _palette(mesh: Mesh) -> FloatArray:
    """Colours (k, 4) of materials, those of textures on average."""
    palette = np.array([each.color for each in mesh.materials])
    for row, each in enumerate(mesh.materials):
        if each.texture is not None:
            palette[row, :3] = each.texture[..., :3].reshape(-1, 3).mean(axis=0) / 255
    return palette


def _vertex_lines(mesh: Mesh) -> list[str]:
    if mesh.vertex_colors is None:
        return [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    rows = np.column_stack([mesh.vertices, mesh.vertex_colors[:, :3]]).tolist()
    return ["v " + " ".join(f"{value:.9g}" for value in row) for row in rows]


def _face_lines(mesh: Mesh, names: list[str], uv_rows: IntArray | None) -> list[str]:
    """Faces in file order, with the material's name where it changes."""
    lines, current = [], -1
    for row, face in enumerate((mesh.faces + 1).tolist()):
        material = int(mesh.face_material[row])
        if material != current:
            lines.append(f"usemtl {names[material]}")
            current = material
        corners = [str(vertex) for vertex in face]
        if uv_rows is not None:
            corners = [f"{a}/{b}" for a, b in zip(face, uv_rows[row], strict=True)]
        lines.append(f"f {' '.join(corners)}")
    return lines


def _material_lines(mesh: Mesh, names: list[str], path: Path) -> list[str]:
    """The material library; writes the textures beside the OBJ file."""
    lines = []
    for name, material in zip(names, mesh.materials, strict=True):
        red, green, blue, alpha = material.color
        lines += [f"newmtl {name}", f"Kd {red:.6g} {green:.6g} {blue:.6g}", f"d {alpha:.6g}"]
        if material.texture is not None:
            image = path.with_name(f"{path.stem}_{name}.png")
            write_image(image, material.texture)
            lines.append(f"map_Kd {image.name}")
    return lines
