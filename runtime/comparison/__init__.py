"""Schemes beside each other: the same questions asked of several scenes."""
