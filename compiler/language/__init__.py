"""The texts within the YAML: expressions, units, numbers, tables."""
