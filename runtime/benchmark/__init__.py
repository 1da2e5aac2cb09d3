"""Speed against error of every method on a topology."""
