"""Proofs of stability over boxes of parameters and ranges of delays."""
