"""Gains between two objectives that no other gains improve in both."""
