"""Published conditions of a virtual wall, over a region of two parameters."""
