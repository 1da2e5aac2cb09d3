"""Parameters of a model: names, values in floats and exactly, overrides, display units."""
