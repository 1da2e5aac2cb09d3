"""Equations written as CasADi functions, each computing only what is asked of it."""
