"""Network damping: the part of the damping at a device that network delay causes.

Takes: a `Model`, a device, the quasi-static damping there.
Gives: `network_damping`.
Guarantees: `network` is the difference between two models, the given one and one in which every tick receives
the current values of all others; both have bounds, and so has the difference.
Does not: cover links whose receivers tick with several clocks.

Slow common motions at v cause forces of K v times the age of the received samples. With packets every T_n,
ticks every T_c and a delay T_d, the age is (T_n − T_c)/2 + T_d on average, to first order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

from apc.compiler.compiled import Model, Timing
from apc.haptics.response_norms import NetworkDamping

# The timing of packets without delay.
AT_ONCE = "at once"


def network_damping(
    model: Model,
    damping: tuple[float, float],
    transparency_at: Callable[[Model], tuple[float, float] | None],
) -> NetworkDamping | None:
    """Return the part of a device's damping that is caused by the network; None if undetermined.

    Parameters
    ----------
    model
        The compiled model, which must be linear.
    damping
        The damping in N·s/m, and its error.
    transparency_at
        The function from a model to its damping and error, None if undetermined.

    Returns
    -------
    The damping; None without a link, or if a link's receivers tick with several clocks.
    """
    receiving = {
        link.name: {
            part.clock
            for peer_type in model.peer_types
            for part in peer_type.clocks
            if any(receive.link == link.name for receive in part.receives)
        }
        for link in model.links
    }
    if not receiving or any(len(clocks) != 1 for clocks in receiving.values()):
        return None
    without_delay = replace(
        model,
        timings=(*model.timings, Timing(AT_ONCE, Fraction(0))),
        links=tuple(
            replace(link, clock=next(iter(receiving[link.name])), delay=AT_ONCE, pairs=(), channel=None)
            for link in model.links
        ),
    )
    damping_without_network = transparency_at(without_delay)
    if damping_without_network is None:
        return None
    return NetworkDamping(damping[0] - damping_without_network[0], damping[1] + damping_without_network[1])
