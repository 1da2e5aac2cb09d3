"""What of the damping that a hand feels comes of the network: everybody's news of the others is old.

Takes: a `CompiledSystem`, a device, what is felt there of slow motions.
Gives: `Viscosity`, `network_viscosity`.
Guarantees: `network` is the difference of two scenes, the one asked for and one in which every tick hears
what the others are at that tick; both have bounds, and so has it.
Does not: tell it of links whose receivers tick with several clocks.

Slow motions of all together at v are followed by forces K v times the age of what is heard: between packets
T_n apart, heard by ticks T_c apart after T_d, that is (T_n − T_c)/2 + T_d at the mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from apc.analysis.analysis import lifted_groups, prepare
from apc.compiler.compiled import CompiledSystem, Link, Timing, count_of
from apc.compiler.language.vectors import whole_and_index
from apc.eigen.peers import PeerGroup
from apc.frame.ages import aged

# The timing of packets that take no time.
AT_ONCE = "at once"


@dataclass(frozen=True, slots=True)
class Viscosity:
    """What the network adds to the damping felt of slow motions, in N·s/m: `network` ± `error`.

    `formula` is what K ((T_n − T_c)/2 + T_d) comes to, of all that moves with the device; None where others
    don't move alike, or peers compute pair by pair.
    """

    network: float
    error: float
    formula: float | None


def network_viscosity(
    system: CompiledSystem,
    damping: tuple[float, float],
    together: bool,
    felt: Callable[[CompiledSystem], tuple[float, float] | None],
) -> Viscosity | None:
    """Return what of a damping comes of the network.

    Parameters
    ----------
    system
        The compiled scene, linear.
    damping
        What is felt in N·s/m, and its error.
    together
        Whether slow motions are of all alike, as nothing holds them back.
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
    return Viscosity(
        damping[0] - without[0], damping[1] + without[1], _of_equals(system) if together else None
    )


def _of_equals(system: CompiledSystem) -> float | None:
    """Return what the formula comes to, None of peers that differ: they may do so in what they hold."""
    groups, _ = lifted_groups(system, prepared=prepare(system))
    if len(groups) > 1:
        return None
    shares = [_by_formula(system, link, groups[0]) for link in system.links]
    known = [one for one in shares if one is not None]
    return float(sum(known)) if len(known) == len(shares) else None


def _by_formula(system: CompiledSystem, link: Link, group: PeerGroup) -> float | None:
    """Return K ((T_n − T_c)/2 + T_d) of a group's peers over a link; None where each sender counts apart.

    K is what those of the group are drawn by together as all others move by 1, over this link.
    """
    kind, site = group.jacobians.kind, group.site
    if link.delays or kind.ports is None or aged(system):  # a prediction by age counts against the delay
        return None
    seconds = {timing.name: float(timing.value) for timing in system.timings}
    period = {clock.name: seconds[clock.period] for clock in system.clocks}
    # All that has a place moves by 1, of what moves along several axes along the first.
    moved = np.array(
        [float(one.unit == "m" and whole_and_index(one.name)[1] in (0, 1)) for one in kind.states]
    )
    parameters = dict(zip(kind.parameters, group.parameters, strict=True))
    zero = [np.zeros(len(one)) for one in (kind.states, kind.holds)]
    pushed, others = kind.ports.port, group.parameters

    def ports(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(pushed(x, u, others, 0.0)).ravel()

    still, half = ports(*zero), len(kind.ports.parts)
    carried = (ports(moved, zero[1]) - still)[:half]
    total = 0.0
    for tick, partition in zip(site.ticks, kind.clocks, strict=True):
        for place, receive in enumerate(partition.receives):
            if receive.link != link.name:
                continue
            if receive.edge is not None or receive.operator not in ("mean", "sum"):
                return None
            send = next((one for one in site.sends if one.link == link.name), None)
            if send is None:
                return None
            many = (
                1.0 if receive.operator == "mean" else parameters.get(count_of(link.name), system.peers - 1)
            )
            heard = float(send.x[receive.channel] @ moved) * many
            age = (period[link.clock] - period[partition.clock]) / 2 + seconds[link.delay]
            for row, hold in enumerate(kind.holds):
                if hold.clock == partition.clock:
                    unit = np.zeros(len(kind.holds))
                    unit[row] = 1.0
                    flows = (ports(zero[0], unit) - still)[half:]
                    total -= float(carried @ flows) * float(tick.r[hold.output, place]) * heard * age
    return total * group.count
