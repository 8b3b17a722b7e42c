"""Loaders of annotated CAD models (KeypointNet, ShapeNet, mesh files), photos, correspondences."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.datasets.colmap import Colmap
    from cadalign.datasets.correspondences import BlindPnP, Correspondences, CorrespondenceSet

    # `open` is not in __all__: a star import must not hide the built-in function.
    from cadalign.datasets.formats import open_correspondences, open_photos
    from cadalign.datasets.formats import open_photos as open  # noqa: F401
    from cadalign.datasets.image_keypoints import (
        ImageKeypoints,
        choose_object,
        join_keypoints,
    )
    from cadalign.datasets.keypoint_files import read_image_keypoints
    from cadalign.datasets.keypointnet import AnnotatedModel, KeypointNet
    from cadalign.datasets.model_keypoints import ModelKeypoint, ModelKeypoints
    from cadalign.datasets.pascal3d import Pascal3D
    from cadalign.datasets.photo import (
        CadModel,
        Photo,
        PhotoDataset,
        PhotoKeypoints,
        PhotoObject,
        Truth,
    )
    from cadalign.datasets.pix3d import Pix3D
    from cadalign.datasets.sample import write_sample_dataset
    from cadalign.datasets.scan2cad import Scan2CAD
    from cadalign.datasets.shapenet import SYNSETS, ShapeNet, ShapeNetModel
    from cadalign.io.meshes.files import check_solid, load_mesh

__all__ = [
    "SYNSETS",
    "AnnotatedModel",
    "BlindPnP",
    "CadModel",
    "Colmap",
    "CorrespondenceSet",
    "Correspondences",
    "ImageKeypoints",
    "KeypointNet",
    "ModelKeypoint",
    "ModelKeypoints",
    "Pascal3D",
    "Photo",
    "PhotoDataset",
    "PhotoKeypoints",
    "PhotoObject",
    "Pix3D",
    "Scan2CAD",
    "ShapeNet",
    "ShapeNetModel",
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
