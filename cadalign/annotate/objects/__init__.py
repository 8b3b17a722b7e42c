"""The objects of a photo, each with its model, and the photos of an object."""
