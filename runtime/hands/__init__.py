"""What hands do to a scene, and what they feel."""
