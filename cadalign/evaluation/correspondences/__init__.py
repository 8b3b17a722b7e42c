"""The experiment on real images with wrong correspondences."""
