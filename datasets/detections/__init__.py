"""Keypoints in images, from detectors and annotation tools."""
