"""Packet losses beyond independent ones: bursts, substitution, recorded delays, consecutive losses."""
