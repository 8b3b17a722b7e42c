"""Structure-from-motion models and other 2D-3D correspondences."""
