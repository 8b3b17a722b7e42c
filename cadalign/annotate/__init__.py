"""Aligning a model to a photo by clicking, in the browser."""
