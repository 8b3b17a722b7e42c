"""Fits of unknown focal length: priors, the grid of focal lengths, the search."""
