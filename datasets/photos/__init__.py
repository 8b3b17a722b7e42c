"""Data sets of photos: objects in them with keypoints, CAD models and true poses."""
