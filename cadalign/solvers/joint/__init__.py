"""Kernels that estimate poses, scales and shape from all evidence together."""
