"""Packets of a whole population over unreliable links: which are lost, late, heard, and at which tick."""
