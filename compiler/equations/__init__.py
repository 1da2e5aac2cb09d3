"""Equations flattened, put on clocks, sorted and solved."""
