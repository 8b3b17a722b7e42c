"""Loaders: annotated CAD models (KeypointNet, ShapeNet, mesh files), and correspondences."""

from cadalign.datasets.detections.image_keypoints import (
    ImageKeypoints,
    choose_object,
    join_keypoints,
)
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.datasets.meshes.load import check_solid, flat_axes, load_mesh
from cadalign.datasets.models.categories import SYNSETS
from cadalign.datasets.models.keypointnet import AnnotatedModel, KeypointNet
from cadalign.datasets.models.keypoints import Circle, Keypoints, RotationalSymmetry, Symmetries
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.datasets.models.shapenet import ShapeNet, ShapeNetModel
from cadalign.datasets.sample.writer import sample_models, write_sample_dataset
from cadalign.datasets.sfm.blind_pnp import BlindPnP
from cadalign.datasets.sfm.bundler import Bundler
from cadalign.datasets.sfm.colmap import Colmap
from cadalign.datasets.sfm.correspondences import Correspondences, CorrespondenceSet
from cadalign.datasets.sfm.formats import CORRESPONDENCE_FORMATS, open_correspondences
from cadalign.datasets.sfm.views import views_from

__all__ = [
    "CORRESPONDENCE_FORMATS",
    "SYNSETS",
    "AnnotatedModel",
    "BlindPnP",
    "Bundler",
    "Circle",
    "Colmap",
    "CorrespondenceSet",
    "Correspondences",
    "ImageKeypoints",
    "KeypointNet",
    "Keypoints",
    "ModelKeypoint",
    "ModelKeypoints",
    "RotationalSymmetry",
    "ShapeNet",
    "ShapeNetModel",
    "Symmetries",
    "check_solid",
    "choose_object",
    "flat_axes",
    "join_keypoints",
    "load_mesh",
    "open_correspondences",
    "read_image_keypoints",
    "sample_models",
    "views_from",
    "write_sample_dataset",
]
