"""Speed against error of every method on a scene."""
