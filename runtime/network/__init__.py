"""Packet timing for a population of peers over unreliable links: losses, delays and reception ticks."""
