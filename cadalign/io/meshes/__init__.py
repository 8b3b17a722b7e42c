"""Mesh files: OBJ with its materials, PLY, GLB, STL, with their faces in file order."""
