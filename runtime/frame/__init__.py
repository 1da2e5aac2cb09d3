"""One peer over one frame: linearization, discretization and lifting, in floats and exactly."""
