"""Uncertainty of an estimate: posterior, residuals and warnings."""
