"""Populations: many different peers, large graphs and long delays, without a matrix of them all."""
