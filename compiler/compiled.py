"""The compiled model: CasADi functions of each peer type, and the communication structure.

Takes: nothing (data types, created by the stage `functions` and read by the runtime).
Gives: `Model` and its parts: `Clock`, `Graph`, `Loss`, `Channel`, `GroupPair`, `Link`; `Formula`, `Timing`,
`Parameter`; `State`, `Hold`, `Receive`, `ClockPartition`, `SendPartition`, `ForcePorts`, `Limit`, `Replaced`,
`PeerType`; `PeerColumn`, `Group`; `PeerTime`, `Experiment`, `Axis`. The names of counted parameters: `PEERS`,
`count_of`, `group_count`, `counts_peers`. Those of an equilibrium: `rest_of`, `start_of`. `LENGTH`, `ANGLES`.
Guarantees: plain frozen data; numbers in SI; periods, phases and delays exact rationals of a second.
Does not: evaluate anything, or read or write files (see `store`).

Every function of a peer type takes some of these vectors, in this order:

    x  (n_x,)  continuous states, in the order of `PeerType.states`
    u  (n_u,)  present outputs of the holds, in the order of `PeerType.holds`
    m  (n_m,)  for a tick: the partition's stored outputs of its previous tick
    r  (n_r,)  for a tick: values received from other peers, in the order of `ClockPartition.receives`
    p  (n_p,)  parameters, in the order of `PeerType.parameters`
    t  ()      time in seconds
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.cache import Origin

# The units of positions: a length; an angle, or a rotation parameter of a body in space.
LENGTH, ANGLES = "m", ("rad", "1")
PEERS = "peers"  # the parameter for the number of all peers
LARGEST_COUNT = 10**9  # of peers in one group
MOST_GROUPS = 1000  # groups of a model: the communication between groups has an entry per pair
MOST_GROUP_ARCS = 2 * 10**6  # arcs of a graph by groups
MOST_PLACED = 10**6  # peers of a model on a graph that isn't complete: several arrays have an entry per peer
REST = "rest("  # prefix of the parameters that replace start values by those of an equilibrium, see `rest_of`
COUNT = "count("  # prefix of the parameters that count received peers of a link, see `count_of`


def count_of(link: str) -> str:
    """Return the name of the parameter for the weighted number of peers received over a link."""
    return f"{COUNT}{link})"


def rest_of(start: str) -> str:
    """Return the name of the parameter that replaces a start value; no part can have this name."""
    return start if start.startswith(REST) else f"{REST}{start})"


def start_of(name: str) -> str:
    """Return the name of the start value that a parameter of `rest_of` replaces; another name unchanged."""
    return name.removeprefix(REST).removesuffix(")") if name.startswith(REST) else name


def group_count(group: str) -> str:
    """Return the name of the parameter for the number of peers of a group; no part can have this name."""
    return f"{group}.count"


def counts_peers(parameter: str) -> bool:
    """Return whether a parameter is a number of peers: of a group, of the model, or received over a link."""
    return parameter == PEERS or parameter.startswith(COUNT) or parameter.endswith(".count")


# Arcs from each peer of a group to each other peer of a group, with their weight.
GroupArc = tuple[str, str, float]


@dataclass(frozen=True, slots=True)
class Clock:
    """A clock with ticks at `phase + k*period`, k = 0, 1, …; `period` and `phase` are names of timings.

    `line` and `column` are the location of the period in the topology, 0 if unknown.
    """

    name: str
    period: str
    phase: str
    line: int = 0
    column: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """The communication graph: "complete", "ring", "star" (the first peer is the center), or "arcs".

    `arcs` (M, 2) are then (sender, receiver) pairs, peers counted from 0 over the groups in order, and
    `weights` (M,) the factors of the sender's packets, each representing its shortest decimal (see
    `weights`); for the other shapes both are empty. `groups` are the sender, receiver and weight of arcs
    between groups, if all arcs are given by groups: `arcs` then follow the counts.
    """

    shape: str
    arcs: NDArray[np.int64]
    weights: NDArray[np.float64]
    groups: tuple[GroupArc, ...] = ()


@dataclass(frozen=True, slots=True)
class Loss:
    """The loss model of packets, netem's `gemodel` (after Gilbert and Elliott): names of four parameters.

    In its good state a directed link loses a packet with probability `one_minus_k`, in its bad state with
    probability `one_minus_h`; after each packet a good link turns bad with probability `p`, a bad link good
    with probability `r`. With r = 1 − p losses are independent.
    """

    p: str
    r: str
    one_minus_h: str
    one_minus_k: str


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """The channel of an unreliable link; directed links are independent.

    `jitter` is the name of a timing, added to the delay times a number drawn from `distribution` ("uniform",
    "normal" or "pareto"). `trace` (n,) has recorded delays in seconds instead, one per packet, infinite for a
    lost packet, repeated periodically. `reorder` selects the packet in effect: the packet sent last
    ("newest") or the packet that arrived last ("all"). `on_loss` is the substitute for a missing packet: the
    previous packet ("hold") or the receiver's own present value ("zero": no difference, no force).
    """

    loss: Loss | None
    jitter: str | None
    distribution: str
    reorder: str
    on_loss: str
    trace: NDArray[np.float64] | None


@dataclass(frozen=True, slots=True)
class GroupPair:
    """The packets of a link from the group `sender` to the group `receiver`; `delay` is the name of a timing.

    With a `channel` or a `clock` of its own, the pair has a timing of its own, which identifies both.
    `channel` is None, and `clock` empty, for that of the link.
    """

    sender: str
    receiver: str
    delay: str
    channel: Channel | None = None
    clock: str = ""


@dataclass(frozen=True, slots=True)
class Link:
    """A network link, which transfers the values sent by every peer to the receivers.

    `clock` is the name of a clock, `delay` of a timing; `pairs` are the pairs of groups with another delay,
    channel or clock. `channel` is None for a link without any unreliable pair. `order` is "before" if a
    packet takes the values before the ticks at its instant, "after" if it takes the values after them; such a
    packet is received at later ticks only.
    """

    name: str
    clock: str
    delay: str
    graph: Graph
    pairs: tuple[GroupPair, ...]
    channel: Channel | None = None
    order: str = "before"

    @property
    def after(self) -> bool:
        """Whether a packet takes the values after the ticks at its instant."""
        return self.order == "after"

    @property
    def delays(self) -> tuple[str, ...]:
        """The names of the timings of all delays, first the link's own."""
        return self.delay, *(pair.delay for pair in self.pairs)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels of the link and of its pairs, without repetition; empty for a reliable link."""
        given = (self.channel, *(pair.channel for pair in self.pairs))
        return tuple(channel for channel in given if channel is not None)

    def channel_at(self, delay: str) -> Channel | None:
        """Return the channel of the packets whose delay is the timing `delay`."""
        named = (pair.channel for pair in self.pairs if pair.delay == delay and pair.channel)
        return next(named, self.channel)

    @property
    def clocks(self) -> tuple[str, ...]:
        """The clocks whose ticks send packets, without repetition, first the link's own."""
        return tuple(dict.fromkeys((self.clock, *(pair.clock for pair in self.pairs if pair.clock))))

    def own_clock(self, delay: str) -> str:
        """Return the clock of the pairs whose delay is the timing `delay`, empty for that of the link."""
        return next((pair.clock for pair in self.pairs if pair.delay == delay), "")

    def clock_at(self, delay: str) -> str:
        """Return the clock that sends the packets whose delay is the timing `delay`."""
        return self.own_clock(delay) or self.clock


@dataclass(frozen=True, slots=True)
class Formula:
    """A formula: the `text` of an expression (see `language.evaluation`) and its `names`."""

    text: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Timing:
    """A period, phase or delay: exact value in seconds; `formula` if it depends on other numbers."""

    name: str
    value: Fraction
    formula: Formula | None = None

    @property
    def number(self) -> Fraction:
        """The exact value, by the same name as in `Parameter`."""
        return self.value


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of the model: SI value; `formula` if computed from other parameters.

    `minimum` is the smallest valid value; `exclusive_minimum` is whether the minimum itself is excluded.
    `exact` is the rational number whose nearest float is `value`, such as 5/3; None if `value` was given as a
    float, which represents its shortest decimal. Times that depend on a parameter are computed from `number`,
    since the equality of times determines the order of events. `display_unit` is the unit in the topology and
    in outputs, as Modelica's displayUnit; empty if it is `unit`. `choices` are the named values of a
    parameter that has no other values, such as a side.
    """

    name: str
    unit: str  # in SI base or derived units, "1" when dimensionless
    value: float
    formula: Formula | None = None
    minimum: float | None = None
    exclusive_minimum: bool = False
    maximum: float | None = None
    description: str = ""
    exact: Fraction | None = None
    display_unit: str = ""
    choices: tuple[tuple[str, float], ...] = ()

    @property
    def number(self) -> Fraction:
        """The exact value."""
        return Fraction(repr(float(self.value))) if self.exact is None else self.exact


@dataclass(frozen=True, slots=True)
class State:
    """A continuous state: name, SI unit, and the parameter for its start value."""

    name: str
    unit: str
    start: str


@dataclass(frozen=True, slots=True)
class Hold:
    """A zero-order hold, a row of u: output `output` of clock partition `clock`.

    A value acts from its tick + the timing `delay` on. Before the first value acts, the hold is zero, or the
    parameter `start` of a model whose start values are those of an equilibrium.
    """

    name: str
    clock: str
    output: int
    delay: str
    start: str = ""


@dataclass(frozen=True, slots=True)
class Receive:
    """A reduction over the newest packets of the other peers, a row of r: `operator` over the peers received
    over a link.

    `age` is the use of the packet ages in seconds since sending: a "factor" of each value, the ages "alone",
    or the last row of s of the "edge". With `before` the value is the reduction of the previous tick; then
    there is no edge.

    "mean" and "sum" are weighted by the link's graph. Without an `edge` the operands are row `channel` of the
    link's `SendPartition`, so that the cost for a complete graph of N peers is proportional to N. With an
    `edge` the operands are `edge(x, u, m, s, p, t)`, one evaluation per pair of peers: x, u, m, p, t are the
    receiving peer's, s (n_c,) the sending peer's channels of the link. "max" and "min" ignore weights.
    """

    name: str
    operator: str
    link: str
    channel: int
    edge: casadi.Function | None = None
    age: str = ""
    before: bool = False


@dataclass(frozen=True, slots=True)
class ClockPartition:
    """The tick function of a subsystem for one clock.

    `tick(x, u, m, r, p, t) -> y (n_y,)`; `outputs` are the names of the rows of y, `units` their SI units;
    `memories` are the rows of y whose values at the previous tick make up m; `starts` are the parameters for
    their start values. With `variants`, y has several such columns, one below the other, and tick k computes
    the column with the number variants[k mod len(variants)]; a compiled model has none (see
    `lifting.data_age`).
    """

    clock: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    memories: tuple[int, ...]
    starts: tuple[str, ...]
    receives: tuple[Receive, ...]
    tick: casadi.Function
    variants: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class SendPartition:
    """The values sent over one link at a tick of its clock: `send(x, u, p, t) -> s (n_c,)`."""

    link: str
    channels: tuple[str, ...]
    units: tuple[str, ...]
    send: casadi.Function


@dataclass(frozen=True, slots=True)
class ForcePorts:
    """The ports with held flows: `port(x, u, p, t) -> (potentials, then flows) (2 n,)`.

    `parts` (n,) are the names of the parts; a flow is positive into its part and depends only on u and p.
    While no hold switches, the work done by a part is −flow · (change of the potential).
    """

    parts: tuple[str, ...]
    port: casadi.Function


@dataclass(frozen=True, slots=True)
class Limit:
    """The limit of a variable's absolute value: the parameter `limit`, which functions may not depend on.

    `value(x, u, p, t) -> the variable (1,)`; None if the variable is a state.
    """

    name: str
    unit: str
    limit: str
    value: casadi.Function | None


@dataclass(frozen=True, slots=True)
class Replaced:
    """A part with other equations in a linear analysis.

    `valid` describes the motions for which they are valid.
    """

    part: str
    equations: tuple[str, ...]
    valid: str


@dataclass(frozen=True, slots=True, eq=False)
class PeerType:
    """All peers with the same structure. `derivative(x, u, p, t) -> dx/dt (n_x,)`.

    A float value of a parameter is exact, except for the sum of weights that a peer receives over a link with
    arcs: different sums have different floats. `hands` are the parts in the section `hands`
    whose force depends on their motion; `held` are the parts that a hand is connected to, or without hands
    the parts with a connector for hands. `joining` are the parts whose values at a joining peer are the mean
    of the other peers'. `linear` is the peer type in a linear
    analysis, with the same states and parameters, None if it is the same; `replaced` are the parts with other
    equations there. `symbols` are the symbols of published wall conditions with their parameters or numbers,
    empty unless every part except hands has symbols.
    """

    name: str
    states: tuple[State, ...]
    holds: tuple[Hold, ...]
    parameters: tuple[str, ...]
    derivative: casadi.Function
    clocks: tuple[ClockPartition, ...]
    sends: tuple[SendPartition, ...]
    ports: ForcePorts | None = None
    hands: tuple[str, ...] = ()
    limits: tuple[Limit, ...] = ()
    held: tuple[str, ...] = ()
    linear: PeerType | None = None
    replaced: tuple[Replaced, ...] = ()
    symbols: tuple[tuple[str, str], ...] = ()
    joining: tuple[str, ...] = ()

    def joins_at_mean(self, name: str) -> bool:
        """Return whether a value such as "cube.x" of a joining peer is the mean of the other peers'."""
        return any(name.startswith(f"{part}.") for part in self.joining)


@dataclass(frozen=True, slots=True, eq=False)
class PeerColumn:
    """A parameter with one value per peer: `values` (count,) in SI units."""

    name: str
    values: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Group:
    """A group of `count` peers of the peer type with index `peer_type`.

    `values` override parameters for this group.

    An override is a `Parameter` of the same name, so that it can have a formula; `columns` override
    parameters for each peer.
    """

    name: str
    count: int
    peer_type: int
    values: tuple[Parameter, ...] = ()
    columns: tuple[PeerColumn, ...] = ()


@dataclass(frozen=True, slots=True)
class PeerTime:
    """The instant `at` in seconds at which a peer such as "user[4]" joins or leaves.

    `line` and `column` are its location in the topology, 0 for an option. `formula` is set if the instant
    depends on parameters.
    """

    peer: str
    at: Fraction
    line: int = 0
    column: int = 0
    formula: Formula | None = None


@dataclass(frozen=True, slots=True)
class Experiment:
    """The duration of a simulation in seconds (None if not given), and the seed of its random numbers.

    `joins` and `leaves` are the peers that join after the start and leave before the end. `formula` is set if
    the duration depends on parameters.
    """

    duration: Fraction | None = None
    seed: int = 0
    joins: tuple[PeerTime, ...] = ()
    leaves: tuple[PeerTime, ...] = ()
    formula: Formula | None = None

    @property
    def formulas(self) -> list[Formula]:
        """The formulas of the duration, joins and leaves that depend on parameters."""
        formulas = (self.formula, *(item.formula for item in self.joins + self.leaves))
        return [formula for formula in formulas if formula is not None]


@dataclass(frozen=True, slots=True)
class Axis:
    """A range of a parameter in SI units.

    `line` and `column` are its location in the topology, 0 if unknown.
    """

    parameter: str
    low: Fraction
    high: Fraction
    line: int = 0
    column: int = 0


@dataclass(frozen=True, slots=True)
class Model:
    """A compiled model. `dropped` are the unused items of the topology, with the reason.

    `followers` are the names of all parameters and timings with a formula, of any group, in order of
    dependence. `warnings` are texts on unusual parts of the topology, with locations. `region` are the axes x
    and y of the study `region`, with none or one if unspecified. `within` are the delays given as a range,
    whose value is the middle of the range. `tune` are the entries of the study `tune`, as option texts.
    `at_equilibrium` states that the model is linearized at its equilibrium instead of its start values.
    """

    name: str
    description: str
    clocks: tuple[Clock, ...]
    links: tuple[Link, ...]
    timings: tuple[Timing, ...]
    parameters: tuple[Parameter, ...]
    peer_types: tuple[PeerType, ...]
    groups: tuple[Group, ...]
    dropped: tuple[tuple[str, str], ...]
    origin: Origin
    experiment: Experiment = Experiment()
    region: tuple[Axis, ...] = ()
    tune: tuple[tuple[str, str], ...] = ()
    followers: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    within: tuple[Axis, ...] = ()
    at_equilibrium: bool = False

    def __repr__(self) -> str:
        """Return a one-line representation."""
        return f"<Model {self.name}: {self.peers} peer{'' if self.peers == 1 else 's'}>"

    def _repr_html_(self) -> str:
        """Return the representation for a notebook."""
        from html import escape  # nothing else needs its list of characters

        return f"<pre>{escape(str(self))}</pre>"

    def __str__(self) -> str:
        """Return the contents of the model, one line per peer type."""
        lines = [f"{self.name}: {self.description}" if self.description else self.name]
        for index, peer_type in enumerate(self.peer_types):
            groups = ", ".join(
                f"{group.count} × {group.name}" for group in self.groups if group.peer_type == index
            )
            states = ", ".join(state.name for state in peer_type.states)
            lines.append(f"  {groups}: {len(peer_type.states)} states ({states})")
        return "\n".join(lines)

    @property
    def peers(self) -> int:
        """The number of peers in the model."""
        return sum(group.count for group in self.groups)
