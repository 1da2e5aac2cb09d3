"""Simulation of a model in time."""
