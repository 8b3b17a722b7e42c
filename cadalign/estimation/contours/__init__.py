"""Masks as evidence: the model's rim is matched to the mask's contour."""
