"""One peer over one frame as a map with error bounds, and the model at its parameter values."""
