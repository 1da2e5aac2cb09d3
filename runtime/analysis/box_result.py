"""The result of a proof of stability over a box of parameters, as data.

Takes: nothing. Gives: `RobustStability`, `ChangingDelay`; `UNDECIDED`.
Guarantees: nothing beyond its fields.
Does not: prove (see `extensions.parameter_boxes`).
"""

from __future__ import annotations

from dataclasses import dataclass

from apc.parameter_values.parameter_names import Range
from apc.result import Result
from apc.verdict import BoxVerdict, Term

UNDECIDED = BoxVerdict.UNDECIDED


@dataclass(frozen=True, slots=True)
class ChangingDelay:
    """The proved results for a delay that changes from packet to packet within a range.

    From the range's lower end to `proved_to` seconds the model is stable under any variation; None if no part
    of the range is proved. `unstable` are two numbers of consecutive packets, with the smallest and with the
    largest delay: their alternation makes the model unstable. `note` is the reason if there is no result.
    """

    proved_to: float | None
    unstable: tuple[int, int] | None
    note: str = ""


@dataclass(frozen=True, slots=True)
class RobustStability(Result):
    """The result of a proof over a box; `stable` is None if neither stability nor instability is proved.

    `cells` is the number of evaluated cells; `undecided_fraction` is the undecided part of the box's volume.
    `counterexample`, SI values in the order of `ranges`, is an unstable point, or the middle of the largest
    undecided cell. `changing`, for a box over a delay alone, is the result for a varying delay.
    """

    shown_by = "analysis_output:box_proof"

    topology: str
    ranges: tuple[Range, ...]
    verdict: Term
    stable: bool | None
    cells: int
    undecided_fraction: float
    counterexample: tuple[float, ...]
    notes: tuple[str, ...]
    limitations: tuple[str, ...] = ()
    changing: ChangingDelay | None = None
