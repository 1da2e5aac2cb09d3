"""Export of a model to the file formats of other tools."""
