"""Gain optimization under robust specifications, with proof of the specifications at the result."""
