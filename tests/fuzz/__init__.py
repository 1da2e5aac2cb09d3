"""Hostile and random input for the compiler: run it with `python -m tests.fuzz`."""
