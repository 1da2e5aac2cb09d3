"""YAML to nodes with places, and typed values out of them."""
