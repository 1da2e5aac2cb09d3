"""Measurements of time: run one with `python -m tests.bench.language`."""
