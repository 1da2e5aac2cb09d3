"""Parameters of a topology estimated from recorded force and motion."""
