"""Draw by ray casting: exact geometry and shaded colour on any machine."""
