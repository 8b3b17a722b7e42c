"""Choice of the model from a library, by retrieval from the pairs marked so far."""
