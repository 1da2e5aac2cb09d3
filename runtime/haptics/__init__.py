"""Human operators: transparency, passivity and norms of a model at its devices."""
