"""Fit models to keypoints: checked input, estimation, and results with their uncertainty."""
