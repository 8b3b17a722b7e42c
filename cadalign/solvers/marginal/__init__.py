"""Kernels that align one view's keypoints to Gaussian shapes: pose alone is searched for."""
