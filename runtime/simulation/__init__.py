"""A model played in time."""
