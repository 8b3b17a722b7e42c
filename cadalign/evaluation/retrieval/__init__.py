"""The retrieval experiment."""
