"""Rendering: scenes, renderers, keypoint visibility, viewpoints and overlays."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.render.overlay import draw_overlay, overlay_model
    from cadalign.render.probe import Probe, make_renderer, probe_renderer
    from cadalign.render.raycast import RaycastRenderer, cast_geometry
    from cadalign.render.scene import Frame, Geometry, Scene
    from cadalign.render.surface import Studio
    from cadalign.render.viewpoints import (
        Angles,
        Viewpoint,
        frame_object,
        look_at,
        pose_in_view,
        sample_view,
        visible_keypoints,
    )

__all__ = [
    "Angles",
    "Frame",
    "Geometry",
    "Probe",
    "RaycastRenderer",
    "Scene",
    "Studio",
    "Viewpoint",
    "cast_geometry",
    "draw_overlay",
    "frame_object",
    "look_at",
    "make_renderer",
    "overlay_model",
    "pose_in_view",
    "probe_renderer",
    "sample_view",
    "visible_keypoints",
]

__getattr__ = lazy_names(__name__)
