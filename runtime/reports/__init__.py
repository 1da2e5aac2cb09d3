"""Reports: all results of topologies, on a page that can be recomputed."""
