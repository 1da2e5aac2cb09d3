"""Topologies and compiled models from files, with the settings of a command."""
