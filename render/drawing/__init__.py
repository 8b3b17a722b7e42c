"""Draw on images: overlays, pictures of geometry, stills."""
