"""Joint estimation of poses, focal lengths, scales and shape from all evidence."""
