"""Warping of meshes, such that their keypoints come to given places."""
