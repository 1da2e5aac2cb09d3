"""Which gains do best in all that they have to bear, and the proof that they bear it."""
