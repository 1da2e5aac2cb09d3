"""The component library: declarations of components, checked, extended, searched."""
