"""Loaders: annotated CAD models (KeypointNet, ShapeNet, mesh files), and correspondences."""

from cadalign.datasets.blind_pnp import BlindPnP
from cadalign.datasets.bundler import Bundler
from cadalign.datasets.categories import SYNSETS
from cadalign.datasets.colmap import Colmap
from cadalign.datasets.correspondences import Correspondences, CorrespondenceSet
from cadalign.datasets.formats import CORRESPONDENCE_FORMATS, open_correspondences
from cadalign.datasets.image_keypoints import (
    ImageKeypoints,
    choose_object,
    join_keypoints,
)
from cadalign.datasets.keypoint_files import read_image_keypoints
from cadalign.datasets.keypointnet import AnnotatedModel, KeypointNet
from cadalign.datasets.keypoints import Circle, Keypoints, RotationalSymmetry, Symmetries
from cadalign.datasets.meshes import check_solid, flat_axes, load_mesh
from cadalign.datasets.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.datasets.sample.writer import sample_models, write_sample_dataset
from cadalign.datasets.shapenet import ShapeNet, ShapeNetModel

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
    "write_sample_dataset",
]
