"""Stability while users join and leave."""
