"""The demonstration on the sample dataset."""
