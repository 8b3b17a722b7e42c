"""Masks and photos as evidence: silhouettes, rims and contours, with OpenCV and embree."""
