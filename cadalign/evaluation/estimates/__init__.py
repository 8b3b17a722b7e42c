"""The experiment on estimates of other programs, read from their files."""
