"""Linearized equations of a peer: Jacobians, branches and kinks, evaluation at a point."""
