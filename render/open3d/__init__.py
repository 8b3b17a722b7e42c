"""Cast rays with Open3D."""
