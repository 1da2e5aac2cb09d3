"""Proof of stability at every constant delay of a link in a range.

Takes: a `Model`, ranges of which one is a link's delay, and a proof of the others at one delay.
Gives: `prove_over_delay`; `varying_delay_result`.
Guarantees: packets are read at ticks, so that the model is constant between two delays at which a packet is
read a tick later. Each such segment is analysed at one interior delay, and each delay between two segments
separately.
Does not: cover random delays (see `mean_square` for jitter).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction

from apc.analysis.box_result import UNDECIDED, ChangingDelay, RobustStability
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.parameter_names import Range
from apc.studies.representative_delays import LOCATION, is_delay, representative_delays
from apc.studies.timing_values import model_with_time
from apc.support.extension_table import find_extension, not_installed
from apc.support.not_supported import NotSupportedError
from apc.verdict import Term

CONSTANT = "for constant delays only, not for delays that vary from packet to packet"

# Parts of a range, from its smallest delay on, for which stability under arbitrary variation is proved.
PARTS = tuple(Fraction(part, 8) for part in range(8, 0, -1))


def prove_over_delay(
    model: Model,
    ranges: Sequence[Range],
    prove: Callable[[Model, list[Range]], RobustStability],
    *,
    nominal: bool,
) -> RobustStability:
    """Return a proof of stability in a box of which one range is a link's delay.

    Parameters
    ----------
    model
        The compiled model.
    ranges
        The ranges of parameters, the delay among them.
    prove
        The function that proves a model with one delay stable in the box of the other ranges, possibly none.
    nominal
        Whether the nominal verdict is required, without losses: the result then includes the proof for a
        delay that changes from packet to packet, if no other range is given.

    Raises
    ------
    ApcError
        E831 two delays, or one that forces use, too; E846 too many segments; the errors of `prove`.
    """
    delays = [interval for interval in ranges if is_delay(model, interval.free)]
    if len(delays) > 1:
        names = " and ".join(dict.fromkeys(delay.free.label for delay in delays))
        raise ApcError(Diagnostic("E831", LOCATION, f"a box can have one delay range, got {names}"))
    (delay,) = delays
    other_ranges = [interval for interval in ranges if interval is not delay]
    index, width = list(ranges).index(delay), delay.high - delay.low
    cells, undecided = 0, Fraction(0)
    verdict: Term = UNDECIDED
    open_point: tuple[float, ...] = ()
    for value, share in representative_delays(model, delay):
        proof = prove(model_with_time(model, delay.free, value), other_ranges)
        cells += proof.cells
        point = (*proof.counterexample[:index], float(value), *proof.counterexample[index:])
        if proof.stable is False:
            return replace(
                proof, ranges=tuple(ranges), cells=cells, undecided_fraction=1.0, counterexample=point
            )
        if proof.stable is None:
            undecided += (share or Fraction(1, 10**9)) / width * Fraction(proof.undecided_fraction or 1.0)
            open_point = open_point or point
        else:
            verdict = proof.verdict
    stable = None if undecided else True
    changing_delay = varying_delay_result(model, delay) if nominal and stable and not other_ranges else None
    notes = (*proof.notes, *[CONSTANT] * (changing_delay is None))
    result = replace(
        proof, ranges=tuple(ranges), cells=cells, notes=notes, stable=stable, changing=changing_delay
    )
    return replace(
        result,
        verdict=UNDECIDED if undecided else verdict,
        undecided_fraction=float(undecided),
        counterexample=open_point,
    )


def varying_delay_result(model: Model, delay: Range) -> ChangingDelay:
    """Return the stability result for a delay that changes from packet to packet within a range."""
    extension = find_extension("loss_models")
    if extension is None:
        return ChangingDelay(None, None, f"undecided: {not_installed('loss_models')}")
    low, width = delay.low, delay.high - delay.low
    try:
        ends = (low + part * width for part in PARTS)
        proved = next((end for end in ends if extension.loop_gain(model, delay.free, low, end) < 1), None)
    except NotSupportedError as why:
        return ChangingDelay(None, None, f"undecided: {why}")
    has_kinks = len(sides(numeric_model(model))) > 1
    unstable = None
    if not has_kinks and proved != delay.high:
        unstable = extension.unstable_delays(model, delay.free, low, delay.high)
    return ChangingDelay(None if proved is None else float(proved), unstable)
