"""HTML of values in notebooks: a small picture beside a table."""
