"""N full peers, event by event, by hand: the check on everything in the runtime, and none of its code.

The topology is the one of `subsystems.paper`: point masses under zero-order-held forces, in closed form. The
matrix of one frame comes column by column, each the frame that starts from one unit vector. Numbers are
floats or FLINT's (`frame_matrix(…, number=as_ball)`, at the working precision set by the caller) or anything
with arithmetic and an `exp`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TopologySource:
    """Everything about the topology, times in exact seconds; `users` overrides values a user.

    `comp` is the delay of every computed force, `contact_comp` another one of the contact's. A number may be
    an array as well, of as many topologies at once.

    `weights` are those of (sender, receiver) pairs, all others are not heard; None is 1 for every pair.
    `late` are delays of pairs other than `comm`. With `pairs`, the stiffness between (receiver, sender), F_T
    is the weighted operator over the differences to each other one, each with a stiffness of its own.
    """

    operator: str = "mean"
    peers: int = 3
    kt: float = 500.0
    bt: float = 0.0
    kc: float = 1000.0
    bc: float = 0.0
    cube: float = 0.2
    cube_damping: float = 5.0
    device: float = 0.1
    device_damping: float = 5.0
    comp: Fraction = Fraction(1, 1000)
    comm: Fraction = Fraction(8, 1000)
    own_delay: bool = False
    contact_comp: Fraction | None = None
    haptic: Fraction = Fraction(1, 1000)
    network: Fraction = Fraction(8, 1000)
    haptic_phase: Fraction = Fraction(0)
    network_phase: Fraction = Fraction(0)
    users: tuple[dict[str, float], ...] = field(default=())
    weights: dict[tuple[int, int], float] | None = None
    late: dict[tuple[int, int], Fraction] = field(default_factory=dict)
    pairs: dict[tuple[int, int], float] = field(default_factory=dict)

    @property
    def contact_delay(self) -> Fraction:
        """The delay of the contact's force."""
        return self.comp if self.contact_comp is None else self.contact_comp

    def receives(self, receiver: int) -> list[tuple[int, float]]:
        """Return whom a peer hears, with weights."""
        others = (sender for sender in range(self.peers) if sender != receiver)
        if self.weights is None:
            return [(sender, 1) for sender in others]
        return [(j, self.weights[j, receiver]) for j in others if (j, receiver) in self.weights]


@dataclass(frozen=True)
class PacketOutcomes:
    """What becomes of packets in one frame: whether each that arrives is there, by (sender, receiver).

    `missed` are the arcs whose last packet before the frame is missing. With `zero` a peer that misses the
    newest packet hears itself in its place, without it the newest that was there before.
    """

    there: Mapping[tuple[int, int], Sequence[bool]]
    missed: Collection[tuple[int, int]] = ()
    zero: bool = False


def as_ball(value: Any) -> flint.arb:
    """Return a number as a ball: FLINT's, at the working precision set by the caller."""
    if isinstance(value, Fraction):
        return flint.arb(flint.fmpq(value.numerator, value.denominator))
    return flint.arb(value)


def frame_matrix(
    topology: TopologySource, *, number: Callable[[Any], Any] = float, exp: Any = math.exp
) -> list[list[Any]]:
    """Return the one-frame matrix of all peers, as rows.

    The state is every peer's (x, v, x_O, v_O), then its last computed forces, newest first, then its last
    packets, newest first: as many as any delay can ask for, so some entries may matter to nobody.
    """
    n, frame, force_depth, packet_depth = _shape(topology)
    columns = []
    for column in range(n):
        state = [number(1 if row == column else 0) for row in range(n)]
        columns.append(_one_frame(topology, state, frame, force_depth, packet_depth, number, exp))
    return [[columns[c][r] for c in range(n)] for r in range(n)]


def arcs_of(topology: TopologySource) -> list[tuple[int, int]]:
    """Return who hears whom, as (sender, receiver)."""
    return [(j, i) for i in range(topology.peers) for j, _ in topology.receives(i)]


def lossy_frame(
    topology: TopologySource, noise: PacketOutcomes
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the one-frame matrix (n, n) in floats, and what pushes at each tick make of the state (n, k).

    Behind the state of `frame_matrix` stands by way the packet, (x, v), that is heard until another is there.
    At each haptic tick every device is pushed anew, by 1 N until the next.
    """
    size, frame, force_depth, packet_depth = _shape(topology)
    n = size + 2 * len(arcs_of(topology))
    rows = np.eye(n + topology.peers * int(frame / topology.haptic))
    found = _one_frame(
        topology, list(rows[:n]), frame, force_depth, packet_depth,
        lambda value: np.asarray(value, dtype=np.float64)[..., None], np.exp, noise, iter(rows[n:]),
    )  # fmt: skip
    whole = np.stack([np.broadcast_to(row, len(rows)) for row in found])
    return whole[:, :n], whole[:, n:]


def states_read(matrices: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the states that others follow from in any of some maps (k, n, n), of those alone."""
    read = np.ones(matrices.shape[1], dtype=bool)
    while not (now := matrices[:, read].any(axis=(0, 1)) & read)[read].all():
        read = now
    return read.nonzero()[0]


def frame_matrices(topology: TopologySource, count: int) -> NDArray[np.float64]:
    """Return the same in floats for many topologies at once, (count, n, n): numbers may be arrays (count,).

    All columns go through one frame together, as rows of numbers.
    """

    def number(value: Any) -> NDArray[np.float64]:
        return np.asarray(value, dtype=np.float64)[..., None]

    n, frame, force_depth, packet_depth = _shape(topology)
    rows = _one_frame(topology, list(np.eye(n)), frame, force_depth, packet_depth, number, np.exp)
    return np.stack([np.broadcast_to(row, (count, n)) for row in rows], axis=1)


def _shape(topology: TopologySource) -> tuple[int, Fraction, int, int]:
    """Return the number of states, the length of a frame, and how many forces and packets are kept."""
    frame = common_period(topology.haptic, topology.network)
    force_depth = math.ceil(max(topology.comp, topology.contact_delay) / topology.haptic) + 1
    packet_depth = math.ceil(max(topology.comm, *topology.late.values(), Fraction(0)) / topology.network) + 1
    return topology.peers * (4 + 3 * force_depth + 2 * packet_depth), frame, force_depth, packet_depth


def common_period(one: Fraction, other: Fraction) -> Fraction:
    """Return the least common multiple of two periods."""
    return Fraction(
        math.lcm(one.numerator * other.denominator, other.numerator * one.denominator),
        one.denominator * other.denominator,
    )


def _one_frame(
    topology: TopologySource,
    state: Sequence[Any],
    frame: Fraction,
    force_depth: int,
    packet_depth: int,
    number: Callable[[Any], Any],
    exp: Any,
    noise: PacketOutcomes | None = None,
    pushes: Iterator[Any] | None = None,
) -> list[Any]:
    """Propagate all peers through one frame; with luck each way's last packet stands behind them."""
    size = 4 + 3 * force_depth + 2 * packet_depth
    behind = iter(state[topology.peers * size :])
    last = {arc: (next(behind), next(behind)) for arc in arcs_of(topology)} if noise else {}
    parts = [list(state[i * size : (i + 1) * size]) for i in range(topology.peers)]
    value = [
        {
            name: number(user.get(name, getattr(topology, name)))
            for name in ("kt", "bt", "kc", "bc", "cube", "cube_damping", "device", "device_damping")
        }
        for user in (topology.users or ({},) * topology.peers)
    ]
    # Times in whole numbers of the unit that measures them all.
    exact = (
        frame, topology.haptic, topology.network, topology.haptic_phase % topology.haptic,
        topology.network_phase % topology.network, topology.comp, topology.contact_delay, topology.comm,
    )  # fmt: skip
    per_second = math.lcm(*(time.denominator for time in (*exact, *topology.late.values())))
    ending, haptic, network, haptic_0, network_0, comp, contact_comp, comm = (
        int(time * per_second) for time in exact
    )
    late = {pair: int(time * per_second) for pair, time in topology.late.items()}
    motion = [part[:4] for part in parts]
    # forces[i] is a list of (time computed, contact, own part, heard part); packets likewise (time, x, v).
    forces, packets = [], []
    for part in parts:
        forces.append(
            [(haptic_0 - (k + 1) * haptic, *part[4 + 3 * k : 7 + 3 * k]) for k in range(force_depth)]
        )
        at = 4 + 3 * force_depth
        packets.append(
            [(network_0 - (k + 1) * network, *part[at + 2 * k : at + 2 * k + 2]) for k in range(packet_depth)]
        )
    pushing = [number(0)] * topology.peers
    instants = {0, ending}
    for start, period, delay in (
        (haptic_0, haptic, comp),
        (haptic_0, haptic, contact_comp),
        (haptic_0, haptic, 0),
        (network_0, network, 0),
        *((network_0, network, delay) for delay in {comm, *late.values()} if noise),
    ):
        first = -(delay // period) - 2
        instants |= {start + k * period + delay for k in range(first, ending // period + 2)}
    times = sorted(time for time in instants if 0 <= time <= ending)

    def newest(listed: Sequence[tuple[Any, ...]], now: int, delay: int) -> tuple[Any, ...]:
        return max((one for one in listed if one[0] + delay <= now), key=lambda one: one[0])

    there = {arc: iter(listed) for arc, listed in noise.there.items()} if noise else {}
    missed = set(noise.missed) if noise else set()

    def receive(j: int, i: int, now: int) -> tuple[Any, ...]:
        if not noise:
            return newest(packets[j], now, late.get((j, i), comm))
        return (now, *(motion[i][2:] if noise.zero and (j, i) in missed else last[j, i]))

    for now, following in itertools.pairwise(times):
        if (now - network_0) % network == 0:
            for i in range(topology.peers):
                packets[i].append((now, motion[i][2], motion[i][3]))
        for arc in last:
            delay = late.get(arc, comm)
            if (now - network_0 - delay) % network == 0:
                missed -= {arc}
                if next(there[arc]):
                    last[arc] = newest(packets[arc[0]], now, delay)[1:]
                else:
                    missed |= {arc}
        if (now - haptic_0) % haptic == 0:
            pushing = [next(pushes) for _ in motion] if pushes else pushing
            for i, (x, v, x_o, v_o) in enumerate(motion):
                p = value[i]
                received = [(number(weight), j, receive(j, i, now)) for j, weight in topology.receives(i)]
                total = sum((weight for weight, _, _ in received), number(0))
                share = total if topology.operator == "mean" else number(1)
                own = number(1) if topology.operator == "mean" else number(topology.peers - 1)
                position = sum((weight * one[1] for weight, _, one in received), number(0)) / share
                velocity = sum((weight * one[2] for weight, _, one in received), number(0)) / share
                owned = own * (p["kt"] * x_o + p["bt"] * v_o)
                others = -p["kt"] * position - p["bt"] * velocity
                if topology.pairs:
                    owned, others = number(0), number(0)
                    for weight, j, one in received:
                        stiffness = number(topology.pairs[i, j])
                        owned += weight / share * (stiffness * x_o + p["bt"] * v_o)
                        others -= weight / share * (stiffness * one[1] + p["bt"] * one[2])
                forces[i].append((now, p["kc"] * (x - x_o) + p["bc"] * (v - v_o), owned, others))
        duration = Fraction(following - now, per_second)
        for i in range(topology.peers):
            p = value[i]
            delayed = newest(forces[i], now, comp)
            contact = newest(forces[i], now, contact_comp)[1]
            at_once = newest(forces[i], now, 0)
            pull = delayed[2] + (at_once if topology.own_delay else delayed)[3]
            x, v, x_o, v_o = motion[i]
            x, v = _coast(x, v, pushing[i] - contact, p["device"], p["device_damping"], duration, number, exp)
            x_o, v_o = _coast(x_o, v_o, contact - pull, p["cube"], p["cube_damping"], duration, number, exp)
            motion[i] = [x, v, x_o, v_o]

    result: list[Any] = []
    for i in range(topology.peers):
        result += motion[i]
        for one in sorted(forces[i], key=lambda one: one[0], reverse=True)[:force_depth]:
            result += one[1:]
        for one in sorted(packets[i], key=lambda one: one[0], reverse=True)[:packet_depth]:
            result += one[1:]
    return [*result, *itertools.chain(*last.values())]


def _coast(
    x: Any, v: Any, force: Any, mass: Any, damping: Any, duration: Fraction, number: Any, exp: Any
) -> tuple[Any, Any]:
    """Move a damped point mass under a constant force: m dv/dt = F − b v."""
    t = number(duration.numerator) / number(duration.denominator)
    if damping == 0:
        return x + t * v + t * t / (number(2) * mass) * force, v + t / mass * force
    decay = exp(-damping * t / mass)
    rise = (number(1) - decay) / damping  # ∫₀ᵗ e^(−b s/m)/m ds
    return x + mass * rise * v + (t - mass * rise) / damping * force, decay * v + rise * force
