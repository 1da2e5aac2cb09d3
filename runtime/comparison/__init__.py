"""Comparison of schemes: the same analyses of several models."""
