"""The equations of an equilibrium, and their root.

Takes: a model at its parameter values, with classes of equal peers.
Gives: `EquilibriumEquations`, `root_of`; `classes_of_equals`; `depends_on_time`; `VELOCITIES`.
Guarantees: a root balances every equation within its rounding, and each contact is on the side of the root.
Every received value is the sender's value at rest. A direction without stiffness keeps its start value.
Does not: decide where the search begins, or build a model (see `rest_position`).

With the states x, the outputs u of holds and the memories m of all peers as one vector z, an equilibrium is a
root of

    der(x)(x, u) = 0,   u = y(x, u, m, r),   m = y(x, u, m, r),   r = mean, sum, … of the others' s(x, u),

with the outputs y of the clocks. Springs S from every position to its start value, which become weaker from
root to root, make each root regular, as stabilization in a finite element program does: a free body then
moves along its force until a contact closes. The last steps are without springs, of minimum norm, with
w S (z − z0) = 0 for every left null vector w of the Jacobian: the mean over equal masses is kept.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ANGLES, LENGTH, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.interpolation import jacobian
from apc.compiler.wording import with_unit
from apc.lifting.initial_reception import StartClasses
from apc.lifting.model_numbers import ModelNumbers, PeerIndices
from apc.lifting.start_parameters import start_parameters, start_units
from apc.linearization.branch_conditions import find_switches, functions_of
from apc.linearization.kinks import active_branches
from apc.linearization.linearize import start_values

# Stiffness of the springs per unit mass in 1/s², from stiff to weak: 1 N at 0.1 kg moves 1 mm, and 100 km.
SPRINGS = (1e4, 1e3, 1e2, 1e1, 1.0, 1e-2, 1e-4)
# With springs a root is a residual of this size relative to the first, in at most this number of steps: the
# last steps, without springs, reach the rounding.
ROOT_TOLERANCE, MOST_STAGE_STEPS = 1e-10, 100
# Singular values below this, relative to the largest, are directions without stiffness: the equations mix
# N/m with numbers, and rounding leaves some 1e-15.
RANK = 1e-12
# The largest residual relative to the terms of its equation: evaluation rounds to some 1e-15 of them, and a
# force of 1 N in balance to 1 nN is below the resolution of every sensor.
BALANCED = 1e-9
# The smallest size of the terms of an equation in SI: its rounding would have no scale at balanced zeros.
SMALLEST = 1e-6
# A force of the springs that keeps this share from one stage to the next is carried by nothing else: a part
# that is held relieves the springs in proportion to their stiffness, at least 10 times.
FREE = 0.5
MOST_STEPS = 20  # without springs; a root has quadratic convergence
MOST_UNKNOWNS = 3000  # of all different peers: beyond, one step takes seconds

VELOCITIES, FORCES = ("m/s", "rad/s"), ("N", "N*m")

Floats = NDArray[np.float64]


def depends_on_time(peer_type: PeerType) -> str:
    """Return the first part of a peer type with an equation that depends on time, "" without one."""
    for _, function, _, rows in functions_of(peer_type):
        timed = function.jac_sparsity(0, function.n_in() - 1).row()
        if timed:
            return str(rows[timed[0] % len(rows)]).rpartition(".")[0] or peer_type.name
    return ""


def classes_of_equals(numeric: ModelNumbers) -> list[PeerIndices]:
    """Return the peers in classes of equal parameters within a group; single peers on another graph.

    Raises
    ------
    ApcError
        E804 too many different peers.
    """
    comm_graph, numbers = numeric.comm_graph, numeric.numbers
    complete = all(map(comm_graph.is_complete, comm_graph.links))
    result, unknowns = [], 0
    for index, group in enumerate(numeric.model.groups):
        start, count = int(comm_graph.starts[index]), len(numbers.parameters[index])
        different = count if complete else group.count
        unknowns += different * len(start_parameters(numeric.model.peer_types[group.peer_type]))
        if unknowns > MOST_UNKNOWNS:
            message = f"the equilibrium of different peers has more than {MOST_UNKNOWNS:,} unknowns"
            location = SourceLocation(comm_graph.topology)
            raise ApcError(Diagnostic("E804", location, message, advice="use fewer different peers"))
        if different == 1:
            result.append(PeerIndices((range(start, start + group.count),)))
            continue
        classes: dict[int, list[range]] = {}
        for peer, row in enumerate(numbers.rows[index].tolist(), start):
            classes.setdefault(row if complete else peer, []).append(range(peer, peer + 1))
        result += [PeerIndices(tuple(runs)) for runs in classes.values()]
    return result


class EquilibriumEquations:
    """The equations of an equilibrium over the unknowns z (n,): x, memories and u of each class of peers.

    `function(z)` returns the residual (n,), its Jacobian (n, n), the received values, and the changes of
    outputs from tick to tick with the ages of packets. `spring` (n, n) is the Jacobian of springs of 1/s².
    """

    def __init__(
        self, numeric: ModelNumbers, classes: Sequence[PeerIndices], start: Mapping[str, float]
    ) -> None:
        self.numeric, self.classes = numeric, classes
        self.starting = StartClasses(numeric, classes)
        self.peer_types = [subsystem.peer_type for subsystem in self.starting.subsystems]
        self.parameters = [[float(value) for value in vector] for vector in self.starting.vectors]
        self.sizes = [len(start_parameters(peer_type)) for peer_type in self.peer_types]
        self.units = np.array([unit for peer_type in self.peer_types for unit in start_units(peer_type)])
        self.kinds = np.array(
            [kind for item in self.peer_types for kind, count in _counts(item) for _ in range(count)]
        )
        self.velocities = (self.kinds == "x") & np.isin(self.units, VELOCITIES)
        self.positions = (self.kinds == "x") & np.isin(self.units, (LENGTH, *ANGLES))
        self.function = self._function()
        self.start = np.array(
            [value for g in range(len(classes)) for value in self._start(g, start)], dtype=np.float64
        )
        self.spring = self._spring()

    def _function(self) -> Any:
        """Return the equations as a CasADi function (see the class)."""
        plain = all(subsystem.walkable for subsystem in self.starting.subsystems)
        symbol: Any = casadi.SX if plain else casadi.MX  # with a nonlinear loop
        z = symbol.sym("z", sum(self.sizes))
        unknowns = []
        for column, peer_type in zip(self.split(z), self.peer_types, strict=True):
            sizes = [len(peer_type.states), *(len(clock.memories) for clock in peer_type.clocks)]
            ends = np.cumsum([0, *sizes, len(peer_type.holds)]).tolist()
            x, *memories, u = casadi.vertsplit(column, ends)
            unknowns.append((x, memories, u))
        sent = [
            {send.link: send.send(x, u, p, 0) for send in peer_type.sends}
            for peer_type, (x, _, u), p in zip(self.peer_types, unknowns, self.parameters, strict=True)
        ]
        residual, received, changes = [], [], [symbol(0)]
        for g, (peer_type, p, (x, memories, u)) in enumerate(
            zip(self.peer_types, self.parameters, unknowns, strict=True)
        ):
            residual.append(peer_type.derivative(x, u, p, 0))
            outputs = {}
            for index, (clock, m) in enumerate(zip(peer_type.clocks, memories, strict=True)):
                reduced = [self._reduced(g, index, n, (x, u, m), sent) for n in range(len(clock.receives))]
                r = casadi.vertcat(symbol(0, 1), *reduced)
                received.append(r)
                values = casadi.densify(clock.tick(x, u, m, r, p, 0))
                columns = casadi.vertsplit(values, len(clock.outputs)) if clock.outputs else [values]
                y = outputs[clock.clock] = columns[clock.variants[0] if clock.variants else 0]
                changes += [column - y for column in columns]
                residual += [m[row] - y[output] for row, output in enumerate(clock.memories)]
            residual += [u[n] - outputs[hold.clock][hold.output] for n, hold in enumerate(peer_type.holds)]
        column = casadi.vertcat(symbol(0, 1), *residual)
        results = [column, jacobian(column, z), casadi.vertcat(symbol(0, 1), *received)]
        results.append(casadi.vertcat(*changes))
        return casadi.Function("equilibrium", [z], [casadi.densify(result) for result in results])

    def _reduced(
        self, g: int, p: int, index: int, own: tuple[Any, Any, Any], sent: Sequence[Mapping[str, Any]]
    ) -> Any:
        """Return the value of a receive at rest: of the senders' present values.

        Parameters
        ----------
        g, p, index
            The receiving class, its clock partition, and the receive.
        own
            The unknowns x, u and m of the receiver.
        sent
            The values sent by each class, by link.
        """
        receive = self.peer_types[g].clocks[p].receives[index]
        if not self.starting.schedules[g].coupling_terms(p, index):
            return 0  # no live value depends on it
        terms = []
        for h, factor in self.starting.factors(receive, g):
            value = sent[h][receive.link]
            if receive.edge is None:
                value = value[receive.channel]
            else:
                value = receive.edge(*own, value[: receive.edge.numel_in(3)], self.parameters[g], 0)
            terms.append(factor * value)
        choices = {"max": casadi.fmax, "min": casadi.fmin}
        if receive.operator in choices:
            return functools.reduce(choices[receive.operator], terms)
        return sum(terms)

    def split(self, z: Any) -> list[Any]:
        """Return the unknowns of each class: of a CasADi column, or of an array."""
        ends = np.cumsum([0, *self.sizes]).tolist()
        return [z[first:last] for first, last in itertools.pairwise(ends)]

    def prefixes(self) -> list[str]:
        """Return the peer or group of each class, as the start of a name; "" for a single class."""
        comm_graph, groups = self.numeric.comm_graph, self.starting.groups
        if len(groups) == 1:
            return [""]
        return [
            f"{comm_graph.groups[group] if groups.count(group) == 1 else comm_graph.peer_name(peers.first)}."
            for group, peers in zip(groups, self.classes, strict=True)
        ]

    def _start(self, g: int, given: Mapping[str, float]) -> list[float]:
        """Return the unknowns of a class at the start: given states, and the start values of the others."""
        subsystem = self.starting.subsystems[g]
        x, u, memories = start_values(subsystem, self.parameters[g])
        names = [
            f"{self.numeric.comm_graph.peer_name(self.starting.peers[g])}.{state.name}"
            for state in subsystem.peer_type.states
        ]
        x = [given.get(name, value) for name, value in zip(names, x, strict=True)]
        return [*x, *(value for memory in memories for value in memory), *u]

    def _spring(self) -> Floats:
        """Return the Jacobian (n, n) of springs of 1/s² from every position to its start.

        A spring acts on the velocities through which a position moves, by the transposed kinematics. Memories
        and other states, which may be integrals, are drawn to their start by their own equation.
        """
        _, slopes = self.evaluated(self.start)
        kinematics = np.nan_to_num(slopes * self.positions[:, None] * self.velocities[None, :])
        moving = self.velocities | kinematics.any(axis=1)
        signs = np.select([self.kinds == "u", moving, self.kinds == "x"], [0.0, 0.0, -1.0], 1.0)
        return np.asarray(np.diag(signs) - kinematics.T, dtype=np.float64)

    def evaluated(self, z: Floats) -> tuple[Floats, Floats]:
        """Return the residual (n,) and its Jacobian (n, n)."""
        residual, slopes, *_ = self.function(z)
        return np.asarray(residual, dtype=np.float64).ravel(), np.asarray(slopes, dtype=np.float64)

    def with_springs(self, z: Floats, stiffness: float) -> tuple[Floats, Floats]:
        """Return the residual and its Jacobian with springs of this stiffness in 1/s²."""
        residual, slopes = self.evaluated(z)
        springs = stiffness * self.spring
        return residual + springs @ (z - self.start), slopes + springs

    def step(self, z: Floats) -> Floats:
        """Return the Newton step of minimum norm without springs (n,); rigid motions return to the start."""
        residual, slopes = self.evaluated(z)
        if not np.isfinite(slopes).all():
            return np.full(len(z), np.nan)
        left, sizes, _ = np.linalg.svd(slopes)
        rigid = left[:, sizes <= RANK * sizes.max(initial=0.0)].T @ self.spring
        rows, right = np.vstack([slopes, rigid]), np.concatenate([-residual, rigid @ (self.start - z)])
        return np.asarray(np.linalg.lstsq(rows, right, rcond=RANK)[0], dtype=np.float64)

    def at_rest(self, z: Floats) -> Floats:
        """Return a point with velocities of 0 instead of their rounding; −0 and 0 are one number."""
        resting = np.where(self.velocities, 0.0, z)
        return (resting if self.balanced(resting) else z) + 0.0

    def balanced(self, z: Floats) -> bool:
        """Return whether each equation is satisfied within its tolerance."""
        residual, slopes = self.evaluated(z)
        return bool((np.abs(residual) <= self._tolerances(z, residual, slopes)).all())

    def _tolerances(self, z: Floats, residual: Floats, slopes: Floats) -> Floats:
        """Return `BALANCED` times the magnitudes of the terms of each equation (n,), at least `SMALLEST`.

        A velocity counts at least as the largest position per second: at rest it is 0 and gives no scale.
        """
        largest = np.abs(np.concatenate([z[self.positions], self.start[self.positions]])).max(initial=0.0)
        sizes = np.maximum(np.abs(z), (largest or 1.0) * self.velocities)
        terms: Floats = np.abs(slopes) @ sizes + np.abs(residual - slopes @ z)
        return BALANCED * np.maximum(terms, SMALLEST)

    def largest_force(self, z: Floats) -> tuple[float, str, float, str]:
        """Return the largest unbalanced force at a point: its size, unit, tolerance and part.

        The force is the output of a hold that changes a velocity at the same rate; without a hold, it is the
        acceleration.
        """
        residual, slopes = self.evaluated(z)
        tolerances = self._tolerances(z, residual, slopes)
        names = [
            f"{prefix}{name}"
            for prefix, peer_type, size in zip(self.prefixes(), self.peer_types, self.sizes, strict=True)
            for name in ([state.name for state in peer_type.states] + [""] * size)[:size]
        ]
        forces = np.flatnonzero((self.kinds == "u") & np.isin(self.units, FORCES))
        found = [(0.0, "N", 0.0, "the topology")]
        for row in np.flatnonzero(self.velocities).tolist():
            gains = [(abs(float(slopes[row, column])), str(self.units[column])) for column in forces.tolist()]
            gain, unit = max(gains, default=(0.0, ""))
            gain, unit = (gain, unit) if gain else (1.0, f"{self.units[row]}^2")
            size, tolerance = (abs(float(values[row])) / gain for values in (residual, tolerances))
            found.append((size, unit, tolerance, names[row].rpartition(".")[0]))
        return max(found[1:] or found)

    def unbalanced(self, z: Floats) -> str:
        """Return the largest unbalanced force at a point, and its part, in words."""
        size, unit, _, name = self.largest_force(z)
        return f"{with_unit(f'{size:.4g}', unit)} remains unbalanced at {name}"

    def active(self, z: Floats) -> tuple[tuple[str, bool], ...]:
        """Return whether each contact or limit is on its steepest branch, by name.

        A nonlinear loop hides its branches.
        """
        result: dict[str, bool] = {}
        received = iter(np.asarray(self.function(z)[2], dtype=np.float64).ravel().tolist())
        for g, (prefix, subsystem) in enumerate(zip(self.prefixes(), self.starting.subsystems, strict=True)):
            values, peer_type = iter(self.split(z)[g].tolist()), subsystem.peer_type
            point: dict[str, Sequence[float]] = {"x": [next(values) for _ in peer_type.states]}
            for index, clock in enumerate(peer_type.clocks):
                point[f"m{index}"] = [next(values) for _ in clock.memories]
                point[f"r{index}"] = [next(received) for _ in clock.receives]
            point |= {"u": [*values], "p": self.parameters[g], "t": [0.0]}
            switched = find_switches(subsystem.equations)
            branches = active_branches(switched, point) if switched.decisions else {}
            result |= {f"{prefix}{name}": on for name, on in branches.items()}
        return tuple(result.items())


def _counts(peer_type: PeerType) -> tuple[tuple[str, int], ...]:
    """Return the kinds of unknowns of a peer type with their numbers: states, memories and holds."""
    memories = sum(len(clock.memories) for clock in peer_type.clocks)
    return ("x", len(peer_type.states)), ("m", memories), ("u", len(peer_type.holds))


def root_of(equations: EquilibriumEquations) -> Floats:
    """Return the root of the equations (n,).

    Raises
    ------
    ApcError
        E847 a force that nothing balances; E848 no convergence; E849 a force that depends on time, or on the
        ages of packets.
    """
    location = SourceLocation(equations.numeric.model.origin.topology)
    at_start = "use --operating-point start"
    timed = next(filter(None, map(depends_on_time, equations.peer_types)), "")
    if timed:
        message = f"a force on {timed} depends on time, so there is no equilibrium"
        raise ApcError(
            Diagnostic("E849", location, message, advice=f"replace it by a constant force, or {at_start}")
        )
    z, forces = _with_weak_springs(equations)
    with_springs, sides = z, equations.active(z)
    for _ in range(MOST_STEPS):
        sides, z = equations.active(z), z + equations.step(z)
        if not np.isfinite(z).all():
            break
        if equations.balanced(z) and equations.active(z) == sides:
            z = equations.at_rest(z + equations.step(z))
            if np.abs(np.asarray(equations.function(z)[3])).max() > SMALLEST:
                message = "a force depends on the ages of packets, so there is no equilibrium"
                raise ApcError(Diagnostic("E849", location, message, advice=at_start))
            return z
    if forces[-1] > FREE * max(forces[-2:]) > 0:  # springs carry it, however weak
        message = f"no equilibrium: {equations.unbalanced(with_springs)}"
        advice = f"hold the part by a spring, a contact or a hand, remove the force, or {at_start}"
        raise ApcError(Diagnostic("E847", location, message, advice=advice))
    subject = "an equation has no finite value or slope"
    if np.isfinite(z).all() and np.isfinite(equations.evaluated(z)[0]).all():
        undecided = ", ".join(sorted({name for name, _ in {*sides} ^ {*equations.active(z)}}))
        subject = equations.unbalanced(z)
        if equations.balanced(z) and undecided:
            subject = f"rounding decides the branch of {undecided}"
    message = f"no equilibrium found: {subject} at the last step"
    advice = (
        'set start values near the equilibrium, take those of apc.operating_point(initial="simulation"), or '
        f"{at_start}"
    )
    raise ApcError(Diagnostic("E848", location, message, advice=advice))


def _with_weak_springs(equations: EquilibriumEquations) -> tuple[Floats, list[float]]:
    """Return the root with the weakest springs, and the norm of their forces at each stage with a root."""
    z, forces = equations.start, [0.0]
    for stiffness in SPRINGS:
        stage = functools.partial(equations.with_springs, stiffness=stiffness)
        if not np.isfinite(stage(z)[0]).all():
            break
        z = _newton(stage, z)
        forces.append(stiffness * float(np.linalg.norm(equations.spring @ (z - equations.start))))
    return z, forces


def _newton(function: Callable[[Floats], tuple[Floats, Floats]], z: Floats) -> Floats:
    """Return the point (n,) of least residual of Newton's method for a piecewise smooth function.

    Notes
    -----
    Full steps with the Jacobian at each point find the root of a piecewise linear monotone function, such as
    the force of a contact. Methods that update one Jacobian over many steps stop at its kink.
    """
    first, best, least = np.nan, z, np.inf
    for _ in range(MOST_STAGE_STEPS):
        residual, slopes = function(z)
        size = float(np.linalg.norm(residual))
        if not np.isfinite(slopes).all() or not np.isfinite(size):
            break
        first = size if np.isnan(first) else first
        if size < least:
            best, least = z, size
        if size <= ROOT_TOLERANCE * first:
            break
        z = z + np.linalg.lstsq(slopes, -residual, rcond=None)[0]
    return best
