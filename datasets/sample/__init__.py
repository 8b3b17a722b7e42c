"""A data set that cadalign makes itself: parametric chairs, bottles, cars and vessels."""

from cadalign.datasets.sample.model import SampleKeypoint, SampleModel
from cadalign.datasets.sample.writer import sample_models, write_sample_dataset

__all__ = ["SampleKeypoint", "SampleModel", "sample_models", "write_sample_dataset"]
