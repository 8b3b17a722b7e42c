"""Silhouettes, rims and contours: masks and photos as evidence, with OpenCV and embree."""
