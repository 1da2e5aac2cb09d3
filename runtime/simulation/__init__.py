"""A scene played in time."""
