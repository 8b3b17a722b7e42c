"""Loaders: annotated CAD models (KeypointNet, ShapeNet, mesh files), photos, correspondences."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.datasets.detections.image_keypoints import (
        ImageKeypoints,
        choose_object,
        join_keypoints,
    )
    from cadalign.datasets.detections.keypoint_files import read_image_keypoints

    # `open` is not in __all__: a star import must not hide the built-in function.
    from cadalign.datasets.formats import open_correspondences, open_photos
    from cadalign.datasets.formats import open_photos as open  # noqa: F401
    from cadalign.datasets.models.keypointnet import AnnotatedModel, KeypointNet
    from cadalign.datasets.models.keypoints import Circle, Keypoints, RotationalSymmetry, Symmetries
    from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
    from cadalign.datasets.models.shapenet import SYNSETS, ShapeNet, ShapeNetModel
    from cadalign.datasets.photos.dataset import PhotoDataset
    from cadalign.datasets.photos.pascal3d import Pascal3D, Pascal3DDetections
    from cadalign.datasets.photos.photo import CadModel, Photo, PhotoKeypoints, PhotoObject, Truth
    from cadalign.datasets.photos.pix3d import Pix3D
    from cadalign.datasets.photos.scan2cad import Scan2CAD
    from cadalign.datasets.sample.writer import write_sample_dataset
    from cadalign.datasets.sfm.blind_pnp import BlindPnP
    from cadalign.datasets.sfm.colmap import Colmap
    from cadalign.datasets.sfm.correspondences import Correspondences, CorrespondenceSet
    from cadalign.io.meshes.files import check_solid, load_mesh

__all__ = [
    "SYNSETS",
    "AnnotatedModel",
    "BlindPnP",
    "CadModel",
    "Circle",
    "Colmap",
    "CorrespondenceSet",
    "Correspondences",
    "ImageKeypoints",
    "KeypointNet",
    "Keypoints",
    "ModelKeypoint",
    "ModelKeypoints",
    "Pascal3D",
    "Pascal3DDetections",
    "Photo",
    "PhotoDataset",
    "PhotoKeypoints",
    "PhotoObject",
    "Pix3D",
    "RotationalSymmetry",
    "Scan2CAD",
    "ShapeNet",
    "ShapeNetModel",
    "Symmetries",
    "Truth",
    "check_solid",
    "choose_object",
    "join_keypoints",
    "load_mesh",
    "open_correspondences",
    "open_photos",
    "read_image_keypoints",
    "write_sample_dataset",
]

__getattr__ = lazy_names(__name__)
