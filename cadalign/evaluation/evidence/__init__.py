"""The experiment on evidence beyond keypoints."""
