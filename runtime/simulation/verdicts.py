"""The verdicts of a simulated motion.

Takes: nothing.
Gives: `AT_REST`, `DECAYS`, `OSCILLATES`, `DIVERGES`, `DRIFTS`, `DRIVEN`, `NOT_DETERMINED`.
Guarantees: the words of every output.
Does not: decide (see `summary`).
"""

AT_REST, DECAYS, OSCILLATES, DIVERGES = "at rest", "decays", "oscillates", "diverges"
DRIFTS, DRIVEN, NOT_DETERMINED = "drifts", "driven", "not determined"
