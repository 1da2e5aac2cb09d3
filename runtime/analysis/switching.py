"""May contacts open and close at will; by one function that falls all the while.

Takes: a `Model` whose peers have parts that switch, and its modes of contact.
Gives: `ArbitrarySwitching`, `switching`.
Guarantees: what is called stable is proved, for every pattern of contacts that are on, off or anything
between, each peer and tick by itself: motions die out, but for what drifts with all contacts open, and that
stays within bounds. The cost grows with the different peers, not with their number.
Does not: say that a scene whose proof fails is unstable, unless a mode of contact is.

It is proved by one quadratic function, the circle criterion (see `circle_criterion`). Functions that know
what was on at the last ticks prove next to nothing more: contacts switch far more often than anything moves.

A force that jumps as its contact opens, as a damped one does, is between none and that of a closed one: what
is proved at will holds of what is linear about it, and loads of constant size leave motions within bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apc.analysis.circle_criterion import is_proved, least_of, weights_of
from apc.analysis.contact_modes import ContactModes
from apc.analysis.opened import LurePlant, open_loops
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.frame.instance import Prepared, prepare
from apc.result import Result
from apc.unserved import NotSupportedError
from apc.verdict import Term


class SwitchingVerdict(Term):
    """The verdict over all patterns of contacts."""

    STABLE = "stable"
    CANNOT = "cannot be"
    OPEN = "not decided"


@dataclass(frozen=True, slots=True)
class ArbitrarySwitching(Result):
    """Whether a scene is stable however its contacts switch; open if neither is proved.

    `reach` is how many times as stiff all contacts might be for the criterion to hold (infinite: any), None
    where it was not worked out; `mode` is where it is nearest to failing. `reason` says why it is not stable
    or not decided.
    """

    shown_by = "analysis_output:switching"

    topology: str
    verdict: SwitchingVerdict
    reason: str
    reach: float | None = None
    mode: str = ""
    jumps: str = ""

    @property
    def stable(self) -> bool | None:
        """True where proved, False where some pattern is unstable, None where it is open."""
        return {SwitchingVerdict.STABLE: True, SwitchingVerdict.CANNOT: False}.get(self.verdict)


@part("switching")
def switching(system: Model, modes: ContactModes, *, prepared: Prepared | None = None) -> ArbitrarySwitching:
    """Say whether contacts may open and close at will.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    modes
        Its modes of contact.
    prepared
        From `instance.prepare`, of this system with these timings.
    """
    if any(link.channel is not None for link in system.links):
        return ArbitrarySwitching(
            system.name,
            SwitchingVerdict.OPEN,
            "packets may be lost or late, and it is looked for on time only",
        )
    if modes.unstable:
        named = " or ".join(modes.unstable)
        when = "in any mode" if len(modes.unstable) == len(modes.modes) else f"when {named}"
        return ArbitrarySwitching(system.name, SwitchingVerdict.CANNOT, f"it is not stable {when}")
    unknown = [mode.name for mode in modes.modes if mode.stable is None or mode.linearized]
    if unknown or modes.notes:
        reason = f"not known when {' or '.join(unknown)}" if unknown else modes.notes[0]
        return ArbitrarySwitching(system.name, SwitchingVerdict.OPEN, reason)
    try:
        return _judge(system.name, open_loops(system, prepared or prepare(system)))
    except NotSupportedError as why:
        return ArbitrarySwitching(system.name, SwitchingVerdict.OPEN, str(why))
    except ApcError as error:
        return ArbitrarySwitching(system.name, SwitchingVerdict.OPEN, error.mistakes[0].sentence)


def _judge(topology: str, loops: Sequence[LurePlant]) -> ArbitrarySwitching:
    """Prove the circle criterion of all loops, or say which fails."""
    jumps = next((loop.jumps for loop in loops if loop.jumps), "")
    try:
        weights = weights_of(loops)
    except NotSupportedError as why:
        return ArbitrarySwitching(topology, SwitchingVerdict.OPEN, str(why), jumps=jumps)
    least, worst = min(((least_of(loop, weights), loop.name) for loop in loops), default=(np.inf, ""))
    reach = float("inf") if least >= 0 else float(-1 / least)
    if not reach > 1:
        reason = f"the circle criterion fails in the {worst} mode"
    elif fails := [loop.name for loop in loops if not is_proved(loop, weights)]:
        reason = f"the circle criterion holds too narrowly to be proved in the {fails[0]} mode"
    else:
        return ArbitrarySwitching(topology, SwitchingVerdict.STABLE, "", reach, worst, jumps)
    return ArbitrarySwitching(topology, SwitchingVerdict.OPEN, reason, reach, worst, jumps)
