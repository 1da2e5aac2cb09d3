"""Many values of some parameters at once, and where between them the verdict changes."""
