"""Views of a topology for users and editors: listing, diagram, picture, schema."""
