"""The component library and the example scenes: YAML only, no code."""
