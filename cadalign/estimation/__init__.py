"""Estimate alignments: from keypoints or all evidence to results with their uncertainty."""
