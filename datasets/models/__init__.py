"""Annotated CAD models: KeypointNet, ShapeNet, and keypoint files."""
