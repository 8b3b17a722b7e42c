"""Cameras, alignments, boxes and meshes, and their conventions."""
