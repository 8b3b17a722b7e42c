"""The engine of experiments: tasks, workers, and folders that resume."""
