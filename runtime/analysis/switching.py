"""May contacts open and close at will: one quadratic function that falls whatever is on, tick by tick.

Takes: a `CompiledSystem` whose peers have parts that switch, and its modes of contact.
Gives: `Switching`, `switching`.
Guarantees: what is called stable is proved, for every pattern of contacts that are on, off or anything
between, each peer and tick by itself: motions die out, but for what drifts with all contacts open, and that
stays within bounds. The cost grows with the different peers, not with their number.
Does not: look for functions that are not quadratic, or that change with the contacts; say that a scene whose
proof fails is unstable, unless a mode of contact is, or contacts that close and open by turns make it grow.

All contacts cut open, H is the lifted map from their forces f, tick by tick over a frame, to the numbers y
they follow (see `pushes`). Closed again f = φ(y) with f(y − f) ≥ 0, at each tick for itself. So the scene
settles if for some weights λ > 0 of the ticks, Λ = diag(λ),

    Λ + He(−Λ H(e^{jθ})) ≻ 0        for all θ

which is the circle criterion (Tsypkin, 1964) on the lifted system. What can drift with all contacts open is a
pole of H at z = 1, R/(z − 1). Where it is one motion, y follows it alike at all ticks, R = c mᵀ, and with
λ = −m/c the rest is free of it: He(−ΛR/(z − 1)) = ΛR/2 on the circle, of either sign of θ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.alternating import alternating
from apc.analysis.analysis import Prepared, prepare
from apc.analysis.contact_modes import ContactModes
from apc.analysis.opened import OpenLoop, open_loops
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.frozen import dataclass
from apc.compiler.timings import part
from apc.compiler.words import counted
from apc.eigen.dissipation import least_real, proves_positive
from apc.frame.discretize import UNIT
from apc.frame.radius import RADII, value_of
from apc.result import Result

Matrix = NDArray[Any]

# λ of a tick of a part at a site, and its radius.
_Weights = dict[tuple[str, str, int], tuple[float, float]]

STABLE, CANNOT, OPEN = "stable", "cannot be", "not decided"


@dataclass(frozen=True, slots=True)
class Switching(Result):
    """Whether a scene is stable however its contacts switch; `verdict` is one of STABLE, CANNOT and OPEN.

    `reach` is how many times as stiff all contacts might be for the criterion to hold (infinite: any), None
    where it was not worked out; `mode` is where it is nearest to failing. `reason` says why it is not stable
    or not decided.
    """

    shown_by = "analysis:switching"

    topology: str
    verdict: str
    reason: str
    reach: float | None = None
    mode: str = ""

    @property
    def stable(self) -> bool | None:
        """True where proved, False where some pattern is unstable, None where it is open."""
        return {STABLE: True, CANNOT: False}.get(self.verdict)


@part("switching")
def switching(system: CompiledSystem, modes: ContactModes, *, prepared: Prepared | None = None) -> Switching:
    """Say whether contacts may open and close at will.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    modes
        Its modes of contact.
    prepared
        From `analysis.prepare`, of this system with these timings.
    """
    if any(link.channel is not None for link in system.links):
        return Switching(system.name, OPEN, "packets may be lost or late, and it is looked for on time only")
    if modes.unstable:
        named = " or ".join(modes.unstable)
        when = "in any mode" if len(modes.unstable) == len(modes.modes) else f"when {named}"
        return Switching(system.name, CANNOT, f"it is not stable {when}")
    unknown = [mode.name for mode in modes.modes if mode.stable is None or mode.linearized]
    if unknown or modes.notes:
        reason = f"not known when {' or '.join(unknown)}" if unknown else modes.notes[0]
        return Switching(system.name, OPEN, reason)
    try:
        found = open_loops(system, prepared or prepare(system))
        return Switching(system.name, OPEN, found) if isinstance(found, str) else _judge(system.name, found)
    except ApcError as error:
        return Switching(system.name, OPEN, error.mistakes[0].sentence)


def _judge(topology: str, loops: Sequence[OpenLoop]) -> Switching:
    """Prove the circle criterion of all loops, or a pattern by which one grows, or say what fails."""
    found = _circle(topology, loops)
    grows = None if found.stable else alternating(loops)
    if grows is None:
        return found
    ticks = f"closed for {counted(grows.closed, 'tick')} and open for {counted(grows.opened, 'tick')}"
    reason = f"with all contacts {ticks} by turns it grows by {grows.growth:.6g} a frame ({grows.mode} mode)"
    return replace(found, verdict=CANNOT, reason=reason)


def _circle(topology: str, loops: Sequence[OpenLoop]) -> Switching:
    """Prove the circle criterion of all loops, or say which fails."""
    drifting = [one for one in loops if one.seen]
    if len(drifting) > 1:
        names = " and ".join(one.name for one in drifting)
        reason = f"with all contacts open, what may drift is of several modes: {names}"
        return Switching(topology, OPEN, reason)
    weights: _Weights = {}
    for one in drifting:
        for k, (site, name, tick) in enumerate(one.ports):
            if not one.seen[k]:
                return Switching(
                    topology, OPEN, f"{name} does not hold what may drift with all contacts open"
                )
            by = -1 / (float(one.seen[k]) * one.counts[k])
            moved, off = (float(one.moved[which, 0, k]) for which in (0, 1))
            weights[site, name, tick] = by * moved, abs(by) * (off + 8 * UNIT * abs(moved))
            if not weights[site, name, tick][0] > weights[site, name, tick][1]:
                return Switching(topology, OPEN, f"{name} drives away what may drift with all contacts open")
    least, worst = np.inf, ""
    for one in loops:
        root = np.sqrt(np.diag(value_of(_weigh(one, weights))))
        a, b, c, d = (value_of(block) for block in (one.a, one.b, one.c, one.d))
        pole = value_of(one.moved)[0] / root
        scaled = b / root, root[:, None] * c, root[:, None] * d / root
        found, _ = least_real(a, *scaled, -np.outer(pole, pole) / 2)
        if found < least:
            least, worst = found, one.name
    reach = float("inf") if least >= 0 else float(-1 / least)
    fails = [one.name for one in loops if not _is_proved(one, weights)]
    if not reach > 1:
        reason = f"the circle criterion fails in the {worst} mode"
    elif fails:
        reason = f"the circle criterion holds too narrowly to be proved in the {fails[0]} mode"
    else:
        return Switching(topology, STABLE, "", reach, worst)
    return Switching(topology, OPEN, reason, reach, worst)


def _weigh(one: OpenLoop, weights: _Weights) -> Matrix:
    """Return the weights of a loop's ticks, of all their peers, on a diagonal with their radii."""
    found = np.zeros((2, len(one.ports), len(one.ports)))
    for k, (port, count) in enumerate(zip(one.ports, one.counts.tolist(), strict=True)):
        value, radius = weights.get(port, (1.0, 0.0))
        found[:, k, k] = value * count, (radius + UNIT * value) * count * (1 + 4 * UNIT)
    return found


def _is_proved(one: OpenLoop, weights: _Weights) -> bool:
    """Say whether a loop's circle criterion is proved with these weights of the ticks."""
    weigh = _weigh(one, weights)
    half = RADII.multiply(np.swapaxes(one.moved / 2, -1, -2), one.moved)
    c, d = (RADII.multiply(weigh, block) for block in (one.c, one.d))
    return proves_positive(one.a, one.b, c, d, RADII.subtract(weigh, half))
