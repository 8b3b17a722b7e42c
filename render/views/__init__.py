"""Place cameras about an object, test visibility, compare silhouettes."""
