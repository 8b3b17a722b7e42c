"""The experiment on objects that are no stretched copy of any model."""
