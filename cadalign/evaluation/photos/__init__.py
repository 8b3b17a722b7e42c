"""Evaluation on data sets of photos."""
