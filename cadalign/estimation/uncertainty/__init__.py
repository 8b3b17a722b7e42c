"""Uncertainty of an estimate, contradictions, and which evidence to add."""
