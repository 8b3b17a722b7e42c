"""Alignment of exact, stretched and learned models to all that is known about an object."""
