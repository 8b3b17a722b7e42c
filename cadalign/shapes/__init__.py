"""Knowledge of a category: learned shape models, and the deformation of meshes."""
