"""The compiled model: CasADi functions of one site per kind, and the exchange between sites as structure.

Takes: nothing (these are the data types the stage `functions` fills and the runtime reads).
Gives: `Model` and its parts, but `Origin` (see `cache`);
`PEERS`, `count_of`, `group_count`, `counts_peers`; `LENGTH`, `ANGLES`.
Guarantees: plain frozen data; numbers in SI; periods, phases and delays exact rationals of a second.
Does not: evaluate anything, or read or write files (see `store`).

Every function of a kind takes some of these vectors, in this order:

    x  (n_x,)  continuous states, in the order of `PeerType.states`
    u  (n_u,)  the values the holds put out at this moment, in the order of `PeerType.holds`
    m  (n_m,)  for a tick: the partition's remembered outputs from its previous tick
    r  (n_r,)  for a tick: what the site hears from the others, in the order of `ClockPartition.receives`
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

# The units of positions: a length; an angle, or what stands for one where a body turns in space.
LENGTH, ANGLES = "m", ("rad", "1")
PEERS = "peers"  # the parameter that holds the number of peers
LARGEST_COUNT = 10**9  # of peers in one group
MOST_GROUPS = 1000  # of a scene: who hears whom is worked out for each two of them
MOST_PLACED = 10**6  # peers of a scene on a graph that isn't complete: each has a place in several arrays
COUNT = "count("  # how those begin that hold how many peers are heard over a link, see `count_of`


def count_of(link: str) -> str:
    """Return the name of the parameter that counts, with their weights, the peers heard over a link."""
    return f"{COUNT}{link})"


def group_count(group: str) -> str:
    """Return the name of the parameter that holds how many peers a group has; no part can have it."""
    return f"{group}.count"


def counts_peers(parameter: str) -> bool:
    """Say whether a parameter is a number of peers: of a group, or what follows from those of groups."""
    return parameter == PEERS or parameter.startswith(COUNT) or parameter.endswith(".count")


@dataclass(frozen=True, slots=True)
class Clock:
    """Ticks at `phase + k*period`, k = 0, 1, …; `period` and `phase` are names of timings.

    `line` and `column` say where in the topology its period stands, 0 if that isn't known.
    """

    name: str
    period: str
    phase: str
    line: int = 0
    column: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """Who hears whom: "complete", "ring", "star" (the first peer is the centre), or "arcs".

    `arcs` (M, 2) are then (sender, receiver) pairs, peers counted from 0 over the groups in order, and
    `weights` (M,) what a receiver multiplies that sender's packets by, each standing for the shortest decimal
    that means it (see `weights`); for the other shapes both are empty.
    """

    shape: str
    arcs: NDArray[np.int64]
    weights: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PairDelay:
    """The delay of a link from one group of peers to another; `delay` is the name of a timing."""

    sender: str
    receiver: str
    delay: str


@dataclass(frozen=True, slots=True)
class Loss:
    """How packets get lost, by netem's `gemodel` (after Gilbert and Elliott): names of four parameters.

    In its good state a way from peer to peer loses a packet with the probability `one_minus_k`, in its bad
    state with `one_minus_h`; after each packet a good one turns bad with the probability `p`, a bad one good
    with `r`. With r = 1 − p losses are independent.
    """

    p: str
    r: str
    one_minus_h: str
    one_minus_k: str


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """What makes a link unreliable; every way from peer to peer on its own.

    `jitter` is the name of a timing, added to the delay times a number drawn from `distribution` ("uniform",
    "normal" or "pareto"). `trace` (n,) are recorded delays in seconds instead, one a packet, infinite for one
    that was lost, from the first again after the last. `reorder` says whether the packet sent last wins
    ("newest") or the one that arrived last ("all"); `on_loss` whether a receiver that misses a packet holds
    the one before ("hold") or takes what it would itself send at that moment ("zero": no difference, no
    force).
    """

    loss: Loss | None
    jitter: str | None
    distribution: str
    reorder: str
    on_loss: str
    trace: NDArray[np.float64] | None


@dataclass(frozen=True, slots=True)
class Link:
    """Carries every sender's channels to those who hear it.

    `clock` is the name of a clock, `delay` of a timing; `delays` are the pairs of groups with a delay of
    their own. `channel` is None for a reliable link.
    """

    name: str
    clock: str
    delay: str
    graph: Graph
    delays: tuple[PairDelay, ...]
    channel: Channel | None = None


@dataclass(frozen=True, slots=True)
class Formula:
    """What a number follows from: the `text` of an expression (see `language.evaluation`) and its `names`."""

    text: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Timing:
    """A period, phase or delay: exact value in seconds; `formula` if it follows from other numbers."""

    name: str
    value: Fraction
    formula: Formula | None = None

    @property
    def number(self) -> Fraction:
        """The value, exact, as a parameter has it."""
        return self.value


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of the scene: SI value; `formula` if it follows from other numbers.

    `minimum` is the least value allowed; `open_minimum` says that the least value itself is excluded.
    `exact` is the rational that `value` is the nearest float to, as 5/3; None where `value` was given as a
    float, in the shortest decimal that means it. Times that depend on a parameter are computed from `number`:
    a tick decides by equality. `display_unit` is the unit in which the scene writes the value, and in which
    people are shown it, as Modelica's displayUnit; empty where that is `unit`.
    """

    name: str
    unit: str  # in SI base or derived units, "1" when dimensionless
    value: float
    formula: Formula | None = None
    minimum: float | None = None
    open_minimum: bool = False
    maximum: float | None = None
    about: str = ""
    exact: Fraction | None = None
    display_unit: str = ""

    @property
    def number(self) -> Fraction:
        """The value, exact."""
        return Fraction(repr(float(self.value))) if self.exact is None else self.exact


@dataclass(frozen=True, slots=True)
class State:
    """A continuous state: name, SI unit, and the parameter that holds its start value."""

    name: str
    unit: str
    start: str


@dataclass(frozen=True, slots=True)
class Hold:
    """Row of u: output `output` of clock partition `clock`, acting from its tick + the timing `delay` on.

    Before the first computed value acts, the hold puts out zero.
    """

    name: str
    clock: str
    output: int
    delay: str


@dataclass(frozen=True, slots=True)
class Receive:
    """Row of r: the `operator` over the others that the peer hears over a link; the newest delivered values.

    `age` says what of it is how old these are, in seconds since they were sent: "factor" multiplies each, or
    it is of ages "alone", or the last row of s of its "edge" is the age. With `before` it is what was heard
    at the tick before; then there is no edge.

    "mean" and "sum" are weighted by the link's graph. Without an `edge` they are of row `channel` of the
    link's `SendPartition`, so that a complete graph of N peers costs N. With an `edge` the operator runs over
    `edge(x, u, m, s, p, t)`, one evaluation a pair of peers: x, u, m, p, t are the hearing peer's, s (n_c,)
    the sending peer's channels of the link. "max" and "min" don't look at weights.
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
    """What a site computes at a tick of one clock.

    `tick(x, u, m, r, p, t) -> y (n_y,)`; `outputs` names the rows of y, `units` their SI units; `memories`
    are the rows of y whose values at the previous tick make up m; `starts` are the parameters holding their
    start values. Where `variants` are given, y is made of several such columns, one below the other, and tick
    k computes the one numbered variants[k mod their number]: none in what was compiled (see `frame.ages`).
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
    """What a site sends over one link at a tick of the link's clock: `send(x, u, p, t) -> s (n_c,)`."""

    link: str
    channels: tuple[str, ...]
    units: tuple[str, ...]
    send: casadi.Function


@dataclass(frozen=True, slots=True)
class ForcePorts:
    """Where held values act on what moves: `port(x, u, p, t) -> (potentials, then flows) (2 n,)`.

    `parts` (n,) names the part of each; a flow counts into its part and follows from u and p alone. A part
    does the work −flow · (change of the potential) while nothing switches.
    """

    parts: tuple[str, ...]
    port: casadi.Function


@dataclass(frozen=True, slots=True)
class Limit:
    """What the size of a variable should stay within: the parameter `limit`, which no function need take.

    `value(x, u, p, t) -> the variable (1,)`; None for one that is a state.
    """

    name: str
    unit: str
    limit: str
    value: casadi.Function | None


@dataclass(frozen=True, slots=True)
class Replaced:
    """A part that other equations represent in a linear analysis; `valid` says for which motions."""

    part: str
    equations: tuple[str, ...]
    valid: str


@dataclass(frozen=True, slots=True, eq=False)
class PeerType:
    """All peers of one structure. `derivative(x, u, p, t) -> dx/dt (n_x,)`.

    A float among the values of a parameter is exact, but where `rounded` has it: by the parameter's place in
    `parameters`, the rationals that floats round, each float at most one of them. `hands` are the parts that
    the scene calls hands, if they answer to how they are moved; `held` the parts that any hand is joined to,
    or without hands those with a connector for hands.
    `linear` is the kind that represents it in a linear analysis, of the same states and parameters, None
    where that is the kind itself; `replaced` are the parts in which they differ.
    `symbols` are those of published wall conditions with the numbers that play them, empty unless every part
    but hands has some.
    """

    name: str
    states: tuple[State, ...]
    holds: tuple[Hold, ...]
    parameters: tuple[str, ...]
    derivative: casadi.Function
    clocks: tuple[ClockPartition, ...]
    sends: tuple[SendPartition, ...]
    ports: ForcePorts | None = None
    rounded: tuple[tuple[int, tuple[Fraction, ...]], ...] = ()
    hands: tuple[str, ...] = ()
    limits: tuple[Limit, ...] = ()
    held: tuple[str, ...] = ()
    linear: PeerType | None = None
    replaced: tuple[Replaced, ...] = ()
    symbols: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PeerColumn:
    """A parameter that differs from peer to peer: `values` (count,) in SI."""

    name: str
    values: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Group:
    """`count` peers of kind `kind` (an index); `values` overrides parameters, by name, for this group.

    An override is a `Parameter` of the same name, so that it can have a formula too; `columns` override
    parameters peer by peer.
    """

    name: str
    count: int
    kind: int
    values: tuple[Parameter, ...] = ()
    columns: tuple[PeerColumn, ...] = ()


@dataclass(frozen=True, slots=True)
class Experiment:
    """How long a simulation runs, in seconds (None if not said), and the seed of what is random in it."""

    duration: Fraction | None = None
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Axis:
    """A range of a parameter, in SI; `line` and `column` are where the topology gives it, 0 if not known."""

    parameter: str
    low: Fraction
    high: Fraction
    line: int = 0
    column: int = 0


@dataclass(frozen=True, slots=True)
class Model:
    """A compiled scene. `dropped` lists what the scene named but does not need, with the reason.

    `followers` are the names of all parameters and timings with a formula, of any group, in an order in which
    each stands behind what it follows from. `warnings` say what the topology seldom means, and where.
    `region` are the axes x and y of the study of that name, empty or one if the scene leaves them open.
    `within` are the delays that are given as a range, in whose middle they are.
    `tune` is what the study of that name asks, each word with its text, as options take them.
    """

    name: str
    about: str
    clocks: tuple[Clock, ...]
    links: tuple[Link, ...]
    timings: tuple[Timing, ...]
    parameters: tuple[Parameter, ...]
    kinds: tuple[PeerType, ...]
    groups: tuple[Group, ...]
    dropped: tuple[tuple[str, str], ...]
    origin: Origin
    experiment: Experiment = Experiment()
    region: tuple[Axis, ...] = ()
    tune: tuple[tuple[str, str], ...] = ()
    followers: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    within: tuple[Axis, ...] = ()

    def __repr__(self) -> str:
        """Return what it is in a line."""
        return f"<Model {self.name}: {self.peers} peer{'' if self.peers == 1 else 's'}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        from html import escape  # nothing else needs its list of characters

        return f"<pre>{escape(str(self))}</pre>"

    def __str__(self) -> str:
        """Return what the model holds, a line a kind of peer."""
        lines = [f"{self.name}: {self.about}" if self.about else self.name]
        for index, kind in enumerate(self.kinds):
            groups = ", ".join(
                f"{group.count} × {group.name}" for group in self.groups if group.kind == index
            )
            states = ", ".join(state.name for state in kind.states)
            lines.append(f"  {groups}: {len(kind.states)} states ({states})")
        return "\n".join(lines)

    @property
    def peers(self) -> int:
        """The number of peers in the scene."""
        return sum(group.count for group in self.groups)
