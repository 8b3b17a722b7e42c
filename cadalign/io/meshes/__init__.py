"""Read and write mesh files, with faces in file order."""
