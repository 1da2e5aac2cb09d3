"""Topologies that are hard for a computer, each with its truth."""
