"""The sparse-keypoint experiment on KeypointNet."""
