"""Proof of stability at every constant delay of a link in a range.

Takes: a `Model`, ranges of which one is a link's delay, and a proof of the others at one delay.
Gives: `is_delay`, `prove_over_delay`, `representative_delays`; `changing`.
Guarantees: a packet is read at ticks, so that between two delays at which it is read a tick later nothing
changes: each such segment is analysed at one interior delay, and each delay between two segments separately.
Does not: cover random delays (see `mean_square` for jitter).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction

from apc.analysis.one_sided_slopes import sides
from apc.analysis.robust_stability import UNDECIDED, ChangingDelay, RobustStability
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.numeric_model import prepare
from apc.frame.parameter_names import ParameterRef, Range
from apc.mean_square.time_varying_delay import loop_gain, unstable_delays
from apc.not_supported import NotSupportedError
from apc.parameter_studies.delay_segments import delay_segments
from apc.parameter_studies.timing_values import system_with_delay
from apc.verdict import Term

LOCATION = SourceLocation("box")

CONSTANT = "at every constant delay: one that changes from packet to packet is not among these"

# Parts of a range, from its smallest delay on, for which stability under arbitrary variation is proved.
PARTS = tuple(Fraction(part, 8) for part in range(8, 0, -1))


def is_delay(system: Model, free: ParameterRef) -> bool:
    """Return whether a timing is the delay of a link, or of some pairs of its peers."""
    return any(free.name in (link.delay, *(pair.delay for pair in link.delays)) for link in system.links)


def prove_over_delay(
    system: Model,
    ranges: Sequence[Range],
    prove: Callable[[Model, list[Range]], RobustStability],
    *,
    nominal: bool,
) -> RobustStability:
    """Return a proof of stability in a box of which one range is a link's delay.

    Parameters
    ----------
    system
        The compiled model.
    ranges
        The ranges of parameters, the delay among them.
    prove
        Proves a model with one delay stable in the box of the other ranges, of which there may be none.
    nominal
        Whether the model's own verdict is required, without losses: the result then includes what is proved
        if the delay changes from packet to packet and no other range is given.

    Raises
    ------
    ApcError
        E831 two delays, or one that forces use, too; E846 too many segments; those of `prove`.
    """
    delays = [interval for interval in ranges if is_delay(system, interval.free)]
    if len(delays) > 1:
        names = " and ".join(dict.fromkeys(delay.free.label for delay in delays))
        raise ApcError(
            Diagnostic("E831", LOCATION, f"one range of one delay is taken in a box, not more: {names}")
        )
    (delay,) = delays
    rest = [interval for interval in ranges if interval is not delay]
    index, width = list(ranges).index(delay), delay.high - delay.low
    cells, left = 0, Fraction(0)
    verdict: Term = UNDECIDED
    open_point: tuple[float, ...] = ()
    for value, share in representative_delays(system, delay):
        proof = prove(system_with_delay(system, delay.free, value), rest)
        cells += proof.cells
        point = (*proof.counterexample[:index], float(value), *proof.counterexample[index:])
        if proof.stable is False:
            return replace(
                proof, ranges=tuple(ranges), cells=cells, undecided_fraction=1.0, counterexample=point
            )
        if proof.stable is None:
            left += (share or Fraction(1, 10**9)) / width * Fraction(proof.undecided_fraction or 1.0)
            open_point = open_point or point
        else:
            verdict = proof.verdict
    stable = None if left else True
    changing_delay = changing(system, delay) if nominal and stable and not rest else None
    notes = (*proof.notes, *[CONSTANT] * (changing_delay is None))
    whole = replace(
        proof, ranges=tuple(ranges), cells=cells, notes=notes, stable=stable, changing=changing_delay
    )
    return replace(
        whole,
        verdict=UNDECIDED if left else verdict,
        undecided_fraction=float(left),
        counterexample=open_point,
    )


def changing(system: Model, delay: Range) -> ChangingDelay:
    """Return the result for a delay that changes from packet to packet within a range."""
    low, width = delay.low, delay.high - delay.low
    try:
        ends = (low + part * width for part in PARTS)
        proved = next((end for end in ends if loop_gain(system, delay.free, low, end) < 1), None)
    except NotSupportedError as why:
        return ChangingDelay(None, None, f"left open, as {why}")
    several = len(sides(system, prepare(system))) > 1
    beyond = None
    if not several and proved != delay.high:
        beyond = unstable_delays(system, delay.free, low, delay.high)
    return ChangingDelay(None if proved is None else float(proved), beyond)


def representative_delays(system: Model, delay: Range) -> Iterator[tuple[Fraction, Fraction]]:
    """Yield representative delays of a range, each with the share of the range that it represents."""
    pieces = delay_segments(
        system, delay.free, delay.low, prepare(system), location=LOCATION, high=delay.high
    )
    for piece in pieces:
        if piece.evaluator is not None:
            message = f"forces wait for {delay.free.label}, too: what happens when changes with it by degrees"
            raise ApcError(Diagnostic("E831", LOCATION, message, hint=f"apc critical {delay.free.label}"))
        high = min(piece.high, delay.high)
        yield piece.low, Fraction(0)
        yield (piece.low + high) / 2, high - piece.low
    yield delay.high, Fraction(0)
