"""The analysis of a scene: which route, its verdict, proofs over boxes, the paper's route, other readings."""
