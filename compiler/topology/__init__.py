"""A topology section by section: who is there, what couples them, what carries."""
