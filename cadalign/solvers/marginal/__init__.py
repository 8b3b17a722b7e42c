"""Alignment of one view's keypoints to Gaussian shapes, with the shape integrated out."""
