"""What of the damping that a hand feels comes of the network: everybody's news of the others is old.

Takes: a `Model`, a device, what is felt there of slow motions.
Gives: `NetworkDamping`, `network_viscosity`.
Guarantees: `network` is the difference of two scenes, the one asked for and one in which every tick hears
what the others are at that tick; both have bounds, and so has it.
Does not: tell it of links whose receivers tick with several clocks.

Slow motions of all together at v are followed by forces K v times the age of what is heard: between packets
T_n apart, heard by ticks T_c apart after T_d, that is (T_n − T_c)/2 + T_d at the mean, to first order in the
age.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.compiled import Model, Timing

# The timing of packets that take no time.
AT_ONCE = "at once"


@dataclass(frozen=True, slots=True)
class NetworkDamping:
    """What the network adds to the damping felt of slow motions, in N·s/m: `network` ± `error`."""

    network: float
    error: float


def network_viscosity(
    system: Model,
    damping: tuple[float, float],
    felt: Callable[[Model], tuple[float, float] | None],
) -> NetworkDamping | None:
    """Return what of a damping comes of the network.

    Parameters
    ----------
    system
        The compiled scene, linear.
    damping
        What is felt in N·s/m, and its error.
    felt
        Tells that of another scene, None where it can't be told.

    Returns
    -------
    None without a link, or where a link's receivers tick with several clocks.
    """
    hearing = {
        link.name: {
            part.clock
            for kind in system.kinds
            for part in kind.clocks
            if any(receive.link == link.name for receive in part.receives)
        }
        for link in system.links
    }
    if not hearing or any(len(clocks) != 1 for clocks in hearing.values()):
        return None
    fresh = replace(
        system,
        timings=(*system.timings, Timing(AT_ONCE, Fraction(0))),
        links=tuple(
            replace(link, clock=next(iter(hearing[link.name])), delay=AT_ONCE, delays=(), channel=None)
            for link in system.links
        ),
    )
    without = felt(fresh)
    if without is None:
        return None
    return NetworkDamping(damping[0] - without[0], damping[1] + without[1])
