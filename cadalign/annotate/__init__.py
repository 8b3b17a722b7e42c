"""Annotator: align a model to photos by clicking in the browser."""
