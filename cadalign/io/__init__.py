"""Read and write files: whole or not at all, with errors that say what is wrong and where."""
