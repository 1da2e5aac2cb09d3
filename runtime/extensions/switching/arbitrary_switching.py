"""Absolute stability under arbitrary switching of contacts, proved by one quadratic Lyapunov function.

Takes: a `NumericModel` whose peers have switching parts, and its contact modes.
Gives: `ArbitrarySwitching`, `arbitrary_switching`.
Guarantees: stable is proved, for every pattern of contacts that are on, off or in between, separately for
each peer and tick: motions decay, except drifts with all contacts open, which stay bounded. The cost grows
with the number of different peers, not of all.
Does not: call a model without a proof unstable, unless a contact mode is.

The proof uses one quadratic function, the circle criterion (see `circle_criterion`). Functions that depend on
the contacts at the last ticks prove next to nothing more: contacts switch far more often than the states
move.

A force that jumps as its contact opens, such as a damped one, is between zero and that of a closed contact:
the proof then holds for the linear part, and constant loads leave motions bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apc.analysis.contact_modes import ContactModes
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.extensions.switching.circle_criterion import is_proved, least_real_part, weights_of
from apc.extensions.switching.lure_form import LurePlant, lure_plants
from apc.lifting.numeric_model import NumericModel
from apc.result import Result
from apc.support.not_supported import NotSupportedError
from apc.verdict import Term


class SwitchingVerdict(Term):
    """The verdict over all patterns of contacts."""

    STABLE = "stable"
    CANNOT = "cannot be"
    OPEN = "not decided"


@dataclass(frozen=True, slots=True)
class ArbitrarySwitching(Result):
    """Stability under arbitrary switching of contacts; `verdict` is one of STABLE, CANNOT and OPEN.

    `reach` is the factor on the stiffness of all contacts up to which the criterion holds (infinite: any),
    None where it was not computed; `mode` is the mode nearest to violating the criterion. `reason` is given
    unless stability is proved. `jumps` names a part whose force jumps, "" if no force does.
    """

    shown_by = "apc.extensions.switching.switching_output:arbitrary_switching"

    topology: str
    verdict: SwitchingVerdict
    reason: str
    reach: float | None = None
    mode: str = ""
    jumps: str = ""

    @property
    def stable(self) -> bool | None:
        """True if stability is proved, False if some pattern of contacts is unstable, None if undecided."""
        return {SwitchingVerdict.STABLE: True, SwitchingVerdict.CANNOT: False}.get(self.verdict)


@part("arbitrary switching")
def arbitrary_switching(
    numeric: NumericModel,
    modes: ContactModes,
) -> ArbitrarySwitching:
    """Return the verdict on a model's stability under arbitrary switching of contacts.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    modes
        Its contact modes.
    """
    model = numeric.model
    if any(link.channel is not None for link in model.links):
        return ArbitrarySwitching(
            model.name,
            SwitchingVerdict.OPEN,
            "the criterion is available for the nominal network only",
        )
    if modes.unstable:
        named = " or ".join(modes.unstable)
        when = "in any mode" if len(modes.unstable) == len(modes.modes) else f"when {named}"
        return ArbitrarySwitching(model.name, SwitchingVerdict.CANNOT, f"it is not stable {when}")
    unknown = [mode.name for mode in modes.modes if mode.stable is None or mode.linearized]
    if unknown or modes.notes:
        reason = f"not known when {' or '.join(unknown)}" if unknown else modes.notes[0]
        return ArbitrarySwitching(model.name, SwitchingVerdict.OPEN, reason)
    try:
        return _common_lyapunov(model.name, lure_plants(numeric))
    except NotSupportedError as why:
        return ArbitrarySwitching(model.name, SwitchingVerdict.OPEN, str(why))
    except ApcError as error:
        return ArbitrarySwitching(model.name, SwitchingVerdict.OPEN, error.mistakes[0].sentence)


def _common_lyapunov(topology: str, loops: Sequence[LurePlant]) -> ArbitrarySwitching:
    """Return the verdict of the circle criterion over all loops, with the loop nearest to violating it."""
    jumps = next((loop.jumps for loop in loops if loop.jumps), "")
    try:
        weights = weights_of(loops)
    except NotSupportedError as why:
        return ArbitrarySwitching(topology, SwitchingVerdict.OPEN, str(why), jumps=jumps)
    least, worst = min(((least_real_part(loop, weights), loop.name) for loop in loops), default=(np.inf, ""))
    reach = float("inf") if least >= 0 else float(-1 / least)
    if not reach > 1:
        reason = f"the circle criterion fails in the {worst} mode"
    elif fails := [loop.name for loop in loops if not is_proved(loop, weights)]:
        reason = f"the circle criterion holds too narrowly to be proved in the {fails[0]} mode"
    else:
        return ArbitrarySwitching(topology, SwitchingVerdict.STABLE, "", reach, worst, jumps)
    return ArbitrarySwitching(topology, SwitchingVerdict.OPEN, reason, reach, worst, jumps)
