"""Results at every point of a grid, on local processes or a cluster, resumable."""
