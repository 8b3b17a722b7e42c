"""Runs of experiments: tasks, workers, and folders of resumable runs."""
