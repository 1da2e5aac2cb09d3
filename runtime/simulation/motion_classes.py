"""The verdicts of a simulated motion.

Takes: nothing.
Gives: `MotionVerdict`.
Guarantees: the words of every output.
Does not: decide (see `summary`).
"""

from apc.verdict import Term


class MotionVerdict(Term):
    """The verdict of a simulated motion, see `summary`."""

    AT_REST = "at rest"
    DECAYS = "decays"
    OSCILLATES = "oscillates"
    DIVERGES = "diverges"
    DRIFTS = "drifts"
    DRIVEN = "driven"
    NOT_DETERMINED = "not determined"
