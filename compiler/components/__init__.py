"""The component library: what a component declares, checked, extended, found."""
