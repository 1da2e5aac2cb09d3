"""The analysis of a model: choice of method, verdict, proofs over boxes, the paper's method, contacts."""
