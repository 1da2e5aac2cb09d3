"""What is written inside the YAML: expressions, units, numbers, tables."""
