"""One peer over one frame: equations linearized, intervals put together, in floats and exactly."""
