"""Metrics of data sets of photos, a module for each, as their papers define them."""
