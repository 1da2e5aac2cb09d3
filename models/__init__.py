"""The component library and the example topologies: YAML only, no code."""
