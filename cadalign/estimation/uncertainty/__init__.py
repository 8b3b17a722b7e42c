"""What is uncertain in an estimate, what contradicts it, and which evidence to add."""
