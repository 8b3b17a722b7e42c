"""Cameras, alignments, boxes and meshes, their conventions and their metrics."""
