"""One frame, event by event with the compiled functions themselves, against the lifted map.

Takes: a `CompiledSystem`. Gives: `check_frame`, `skipped`.
Guarantees: uses neither the Jacobians nor the exponentials of `linearize` and `lift`; start values and
constant forces are seen to cancel.
Does not: check a site whose equations are not affine, as its lifted map holds near one point only, or one
that hears by an edge function (see `skipped`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.frame.batch_lift import exponential_rows
from apc.runtime.frame.discretize import TOO_LARGE, UNIT
from apc.runtime.frame.jacobians import SiteJacobians, jacobians
from apc.runtime.frame.lift import lift
from apc.runtime.frame.linearize import linearize
from apc.runtime.frame.parameters import Numbers, resolve
from apc.runtime.frame.schedule import Act, Propagate, Schedule, Send, Tick, Value
from apc.runtime.frame.scheduling import build_schedules
from apc.runtime.threads import single_threaded
from apc.runtime.trouble import finite_equations

Floats = NDArray[np.float64]

# The seed of the random states: any will do, the same one gives the same answer.
SEED = 20_090_616

# Sites of one kind that are checked: they differ in numbers only, which the functions take as they come.
MOST_CHECKED = 3

# How much more than the proven rounding of the lifted map the two may differ: stepping rounds as well, in
# another order, and its exponentials lose log₂‖A T‖ bits that the lifted map's keep.
MARGIN = 1e2


def check_frame(system: CompiledSystem) -> float:
    """Compare one frame of every kind, both ways, at random; return the largest relative difference.

    Raises
    ------
    AssertionError
        The two differ by more than rounding.
    """
    numbers = resolve(system)
    sites = [jacobians(kind) for kind in system.kinds]
    schedules = build_schedules(system, numbers.timings, [site.pattern for site in sites])
    generator = np.random.default_rng(SEED)
    largest = 0.0
    with single_threaded(), finite_equations(system.name), np.errstate(all="ignore"):
        for site, schedule, parameters in _checked(system, numbers, sites, schedules):
            lifted = lift(linearize(site, parameters), schedule)
            z = generator.standard_normal(len(lifted.z_names))
            r = generator.standard_normal(len(schedule.heard))
            moved, sent = _frame(site.kind, schedule, parameters, z, r)
            still, sent_still = _frame(site.kind, schedule, parameters, 0 * z, 0 * r)
            stepped = np.concatenate([moved - still, sent - sent_still])
            mapped = np.concatenate([lifted.p @ z + lifted.q @ r, lifted.s @ z + lifted.d @ r])
            # Forces and displacements differ by the stiffness: each row is measured by its own terms.
            size = np.concatenate(
                [
                    np.abs(lifted.p) @ np.abs(z)
                    + np.abs(lifted.q) @ np.abs(r)
                    + np.abs(moved)
                    + np.abs(still),
                    np.abs(lifted.s) @ np.abs(z)
                    + np.abs(lifted.d) @ np.abs(r)
                    + np.abs(sent)
                    + np.abs(sent_still),
                ]
            )
            proven = np.concatenate(
                [
                    lifted.p_error @ np.abs(z) + lifted.q_error @ np.abs(r),
                    lifted.s_error @ np.abs(z) + lifted.d_error @ np.abs(r),
                ]
            )
            if not (np.isfinite(size).all() and np.isfinite(proven).all()):
                raise ApcError(Mistake("E806", Place(system.name), TOO_LARGE))
            stiffness = 1.0 + _largest_rate(site, parameters) * float(schedule.frame_s)
            apart = np.abs(stepped - mapped)
            different = float(np.max(apart[size > 0] / size[size > 0], initial=0.0))
            assert (apart <= MARGIN * (proven + stiffness * UNIT * size)).all(), (
                f"one frame of {site.kind.name}, stepped and lifted, differ by {different:.1e}"
            )
            largest = max(largest, different)
    return largest


def _largest_rate(site: SiteJacobians, parameters: Floats) -> float:
    """Return the norm of A, in 1/s."""
    return float(np.abs(linearize(site, parameters).a).sum(axis=0).max(initial=0.0))


def skipped(system: CompiledSystem) -> tuple[str, ...]:
    """Return the kinds that are not checked, as they are not affine or look at each sender by itself."""
    sites = [jacobians(kind) for kind in system.kinds]
    return tuple(site.kind.name for site in sites if not site.parameters_suffice)


def _checked(
    system: CompiledSystem,
    numbers: Numbers,
    sites: Sequence[SiteJacobians],
    schedules: Sequence[Schedule],
) -> Iterator[tuple[SiteJacobians, Schedule, Floats]]:
    """Yield the sites to check: of every kind, the first few that differ in numbers or schedule."""
    seen: dict[int, set[tuple[int, bytes]]] = {}
    for group, schedule, rows in zip(system.groups, schedules, numbers.parameters, strict=True):
        site, known = sites[group.kind], seen.setdefault(group.kind, set())
        if not site.parameters_suffice:
            continue
        for parameters in rows[:MOST_CHECKED]:
            key = (id(schedule), parameters.tobytes())
            if len(known) < MOST_CHECKED and key not in known:
                known.add(key)
                yield site, schedule, parameters


def _frame(kind: Kind, schedule: Schedule, p: Floats, z: Floats, r: Floats) -> tuple[Floats, Floats]:
    """Step a site through one frame, from z and with r heard; return z⁺ and s."""
    n_x = len(kind.states)
    x = z[:n_x].copy()
    value = dict(zip(schedule.carried, z[n_x:], strict=True))
    u = np.array([value.get(one, 0.0) if one is not None else 0.0 for one in schedule.acting])
    sent = np.zeros(len(schedule.sent))
    for event in schedule.events:
        match event:
            case Propagate(duration):
                x = _propagate(kind, x, u, p, float(duration * schedule.quantum))
            case Act(hold, one):
                u[hold] = value.get(one, 0.0)
            case Send(partition, rows):
                everything = _vector(kind.sends[partition].send(x, u, p, 0.0))
                for channel, row in rows:
                    sent[row] = everything[channel]
            case Tick(partition, index, rows_heard):
                computing = kind.clocks[partition]
                m = np.array([value.get(Value(partition, o, index - 1), 0.0) for o in computing.memories])
                received = np.array([r[list(rows)].sum() for rows in rows_heard])
                outputs = _vector(computing.tick(x, u, m, received, p, 0.0))
                value |= {Value(partition, o, index): number for o, number in enumerate(outputs)}
    after = [
        value[Value(one.partition, one.output, one.index + schedule.ticks[one.partition])]
        for one in schedule.carried
    ]
    return np.concatenate([x, after]), sent


def _propagate(kind: Kind, x: Floats, u: Floats, p: Floats, duration: float) -> Floats:
    """Return x after `duration` seconds with u constant: dx/dt = A x + c, exactly, A column by column."""
    n = len(x)
    constant = _vector(kind.derivative(np.zeros(n), u, p, 0.0))
    # At rest without forces: beside large ones the rates of small displacements would be lost to rounding.
    at_rest = _vector(kind.derivative(np.zeros(n), 0 * u, p, 0.0))
    columns = [_vector(kind.derivative(unit, 0 * u, p, 0.0)) - at_rest for unit in np.eye(n)]
    a = np.reshape(columns, (n, n)).T
    # By scaling and squaring in floats, where `lift` exponentiates in balls; SciPy's takes 100 ms to import.
    step, _, _ = exponential_rows(a[None], constant[None, :, None], duration)
    return np.asarray(step[0] @ np.append(x, 1.0))


def _vector(result: Any) -> Floats:
    """Return a CasADi column as a vector."""
    return np.asarray(result, dtype=np.float64).reshape(-1)
