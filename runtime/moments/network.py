"""Is a scene stable in mean square over the network that it has, lost and late packets included.

Takes: a `CompiledSystem` whose links say loss, jitter or a trace.
Gives: `NetworkVerdict`, `judge_network`; `Growth`, `growth`; `unreliable`.
Guarantees: a network that can't be judged is not: a note says by name why.
Does not: look at the nominal network (see `analysis`).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from apc.analysis.analysis import Prepared, prepare
from apc.compiler.compiled import CompiledSystem, Link
from apc.finite_equations import finite_equations
from apc.frame.parameters import resolve
from apc.moments.crowd import crowd
from apc.moments.gains import mean_square_radius
from apc.moments.memory import is_memoryless
from apc.moments.patterns import MOST_CHANNELS, pattern_radius, patterns
from apc.network.channel import ChannelLaw, channel_law
from apc.result import Result
from apc.threads import single_threaded

STABLE = "stable in mean square"
UNSTABLE = "unstable in mean square"
UNDECIDED = "undecided"
NOT_JUDGED = "not judged"


@dataclass(frozen=True, slots=True)
class LossesInARow:
    """The worst case: losses in a row certified harmless, and a pattern that shakes the scene.

    `unstable_pattern` says of each frame of a period whether its packets are lost; `growth` is per frame.
    """

    certified: int | None
    unstable_pattern: tuple[bool, ...] | None
    growth: float | None


@dataclass(frozen=True, slots=True)
class NetworkVerdict(Result):
    """What becomes of a scene whose packets get lost or come late by chance.

    `mean_square_radius` is what second moments grow by in a frame, right to `error`; `exact` is False where
    it is an estimate. `rms_error_m` is how far a copy is from the mean of the others; null where not asked or
    not served, as `notes` say.
    """

    shown_by = "network:network"

    topology: str
    verdict: str
    stable: bool | None
    mean_square_radius: float | None
    error: float | None
    exact: bool
    proof: str
    rms_error_m: float | None
    losses_in_a_row: LossesInARow | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Growth:
    """What second moments grow by in a frame, with bounds; estimates where `exact` is False.

    `why` says why there is none.
    """

    radius: float
    low: float
    high: float
    exact: bool
    why: str = ""
    proof: str = ""

    @property
    def stable(self) -> bool | None:
        """Whether second moments die out, None where bounds leave it open."""
        return True if self.high < 1 else False if self.low > 1 else None


def unreliable(system: CompiledSystem) -> list[tuple[Link, ChannelLaw]]:
    """Return the links that lose packets or delay them by chance, with their laws."""
    timings = resolve(system).timings
    laws = [
        (link, channel_law(system, link, timings[link.delay])) for link in system.links if link.channel is not None
    ]
    return [(link, law) for link, law in laws if law.mean_loss or law.jitter or law.trace is not None]


def growth(system: CompiledSystem, prepared: Prepared) -> Growth:
    """Return what second moments grow by in a frame, common translations left out.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it with any numbers.
    """
    lossy = unreliable(system)
    if why := _unserved(system, prepared, lossy):
        return Growth(np.nan, 0.0, np.inf, False, why)
    by_chance = all(is_memoryless(law) for _, law in lossy)
    if by_chance and all(link.channel.on_loss == "hold" for link, _ in lossy):
        found = mean_square_radius(crowd(system, prepared))
        return Growth(found.radius, found.low, found.high, True)
    first, why = _due(system, prepared, lossy)
    if why:
        return Growth(np.nan, 0.0, np.inf, False, why)
    radius = pattern_radius(patterns(system, prepared, first))
    return Growth(radius, radius, radius, True)
