"""The result of runs as one page, and as tables for papers."""
