"""Draw colour with OpenGL through pyrender."""
