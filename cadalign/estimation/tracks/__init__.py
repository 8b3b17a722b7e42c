"""An object through a video: one shape, smooth motion, poses at all times."""
