"""Network damping: the part of the damping at a device that network delay causes.

Takes: a `Model`, a device, the quasi-static damping there.
Gives: `NetworkDamping`, `network_damping`.
Guarantees: `network` is the difference between two models, the given one and one in which every tick receives
the current values of all others; both have bounds, and so has the difference.
Does not: cover links whose receivers tick with several clocks.

Slow common motions at v cause forces of K v times the age of the received samples: with packets every T_n,
ticks every T_c and a delay T_d, that is (T_n − T_c)/2 + T_d on average, to first order in the age.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.compiled import Model, Timing

# The timing of packets without delay.
AT_ONCE = "at once"


@dataclass(frozen=True, slots=True)
class NetworkDamping:
    """The damping that the network adds to slow motions, in N·s/m: `network` ± `error`."""

    network: float
    error: float


def network_damping(
    system: Model,
    damping: tuple[float, float],
    transparency_at: Callable[[Model], tuple[float, float] | None],
) -> NetworkDamping | None:
    """Return the part of a damping that the network causes.

    Parameters
    ----------
    system
        The compiled model, linear.
    damping
        The damping in N·s/m, and its error.
    transparency_at
        Returns the damping of another model, None where undetermined.

    Returns
    -------
    None without a link, or where a link's receivers tick with several clocks.
    """
    receiving = {
        link.name: {
            part.clock
            for peer_type in system.peer_types
            for part in peer_type.clocks
            if any(receive.link == link.name for receive in part.receives)
        }
        for link in system.links
    }
    if not receiving or any(len(clocks) != 1 for clocks in receiving.values()):
        return None
    fresh = replace(
        system,
        timings=(*system.timings, Timing(AT_ONCE, Fraction(0))),
        links=tuple(
            replace(link, clock=next(iter(receiving[link.name])), delay=AT_ONCE, delays=(), channel=None)
            for link in system.links
        ),
    )
    without = transparency_at(fresh)
    if without is None:
        return None
    return NetworkDamping(damping[0] - without[0], damping[1] + without[1])
