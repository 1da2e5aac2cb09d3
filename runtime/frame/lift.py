"""One frame of one site as one linear map.

Takes: a `LinearSite` and its `Schedule`.
Gives: `LiftedSite`, `lift`; `follow`, the same frame over numbers of any kind.
Guarantees: the continuous part is propagated by its exact exponential; every matrix comes with a bound on
its rounding error, entry by entry.
Does not: know who the others are (see `modes`).

    z⁺ = P z + Q r        z: continuous states, then the remembered values (`Schedule.carried`)
    s  = S z + D r        r: what the site hears (`Schedule.heard`), s: what it sends (`Schedule.sent`)

D is what is sent after something was heard in the same frame: nilpotent, as nothing is heard before it is
sent.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT, discretize
from apc.frame.schedule import Act, Propagate, Schedule, Send, Tick, Value
from apc.frame.site import LinearSite, magnitudes

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Rounding errors charged to every coefficient a site's functions give, in units of UNIT: CasADi evaluates
# short polynomials of the parameters, a few roundings an entry.
COEFFICIENT_ROUNDINGS = 8


@dataclass(frozen=True, slots=True)
class LiftedSite:
    """The one-frame map of a site. `*_error` bounds the rounding error of the matrix, entry by entry."""

    z_names: tuple[str, ...]
    continuous: int  # the first so many entries of z are continuous states
    frame_s: float
    p: Floats  # (n_z, n_z)
    q: Floats  # (n_z, n_r)
    s: Floats  # (n_s, n_z)
    d: Floats  # (n_s, n_r)
    p_error: Floats
    q_error: Floats
    s_error: Floats
    d_error: Floats


def lift(site: LinearSite, schedule: Schedule, *, exact: LinearSite | None = None) -> LiftedSite:
    """Compose a site's events over one frame.

    Parameters
    ----------
    site
        The site's matrices, in floats.
    schedule
        What happens in a frame.
    exact
        The site's matrices in rationals, whose exponentials are taken; without it, those of `site` count as
        exact.

    Notes
    -----
    Rounding: a sum of k products is off by at most γ_k = k·u/(1 − k·u) times the same sum of magnitudes
    (Higham, Accuracy and Stability of Numerical Algorithms, section 3.1). The factors multiply along a
    composition, so the whole frame is off by at most γ times the composition of the magnitudes, with the
    roundings of every event added up. That bound holds whatever the scaling of the states.
    """
    durations = sorted({event.duration for event in schedule.events if isinstance(event, Propagate)})
    exact = site if exact is None else exact
    found = discretize(exact.a, exact.b, [duration * schedule.quantum for duration in durations])
    steps = {duration: step.matrix for duration, step in zip(durations, found, strict=True)}
    large_steps = {duration: step.size for duration, step in zip(durations, found, strict=True)}
    frame = _compose(site, schedule, steps)
    large = _compose(magnitudes(site), schedule, large_steps)

    size = sum(site.b.shape)
    width = size + max((tick.m.shape[1] + tick.r.shape[1] for tick in site.ticks), default=0)
    width += len(schedule.heard)
    roundings = sum(
        size + 1 if isinstance(event, Propagate) else width + COEFFICIENT_ROUNDINGS
        for event in schedule.events
        if not isinstance(event, Act)
    )
    gamma = roundings * UNIT / (1 - roundings * UNIT)

    n_z = len(site.kind.states) + len(schedule.carried)
    z, s = frame
    z_large, s_large = large
    return LiftedSite(
        z_names=(*(state.name for state in site.kind.states), *schedule.value_names),
        continuous=len(site.kind.states),
        frame_s=float(schedule.frame_s),
        p=z[:, :n_z],
        q=z[:, n_z:],
        s=s[:, :n_z],
        d=s[:, n_z:],
        p_error=gamma * z_large[:, :n_z],
        q_error=gamma * z_large[:, n_z:],
        s_error=gamma * s_large[:, :n_z],
        d_error=gamma * s_large[:, n_z:],
    )


def _compose(site: LinearSite, schedule: Schedule, steps: Mapping[int, Floats]) -> tuple[Floats, Floats]:
    """Follow z and r through one frame; return (z⁺, s), every row over the columns (z, r)."""
    n_z = len(site.kind.states) + len(schedule.carried)
    unit = np.eye(n_z + len(schedule.heard))
    sent = np.zeros((len(schedule.sent), len(unit)))
    course = follow(site, schedule, steps, unit[:n_z], lambda row: unit[n_z + row])
    while True:
        try:
            row, packet = next(course)
        except StopIteration as end:
            return end.value, sent
        sent[row] = packet


def follow(
    site: LinearSite,
    schedule: Schedule,
    steps: Mapping[int, Matrix],
    start: Matrix,
    hear: Callable[[int], Matrix | None],
    *,
    multiply: Callable[[Matrix, Matrix], Matrix] = np.matmul,
    watch: Callable[[int, Matrix], None] | None = None,
) -> Generator[tuple[int, Matrix], None, Matrix]:
    """Follow a site through one frame, event by event, over numbers of any kind.

    Every quantity is a row over columns of the caller's choice.

    Parameters
    ----------
    site
        The site's matrices, in the kind of number wanted.
    schedule
        What happens in a frame.
    steps
        [F G] (n_x, n_x + n_u) by duration in quanta.
    start
        The state z (n_z, columns) at the start of the frame.
    hear
        Gives the row (columns,) of an entry of r, or None while it isn't sent yet: it is asked again.
    multiply
        The product of a site's matrix and rows.
    watch
        Is shown each step before it is made: its duration in quanta, and the continuous states above what the
        holds put out (n_x + n_u, columns).

    Yields
    ------
    The row of s and its value (columns,) as soon as it is sent; (−1, nothing) while waiting to hear.

    Returns
    -------
    z⁺ (n_z, columns).
    """
    n_x = len(site.kind.states)
    nothing = np.zeros(start.shape[1], dtype=start.dtype)
    value: dict[Value, Matrix] = {one: start[n_x + row] for row, one in enumerate(schedule.carried)}
    # The continuous states above what the holds put out: a step multiplies both at once.
    acting = [nothing if one is None else value.get(one, nothing) for one in schedule.acting]
    moving = np.vstack([start[:n_x], *acting])
    sends = [np.hstack([send.x, send.u]) for send in site.sends]
    ticks = [np.hstack([tick.x, tick.u, tick.m, tick.r]) for tick in site.ticks]
    for event in schedule.events:
        match event:
            case Propagate(duration):
                if watch is not None:
                    watch(duration, moving)
                moving[:n_x] = multiply(steps[duration][:n_x], moving)
            case Act(hold, one):
                moving[n_x + hold] = value.get(one, nothing)
            case Send(partition, rows):
                everything = multiply(sends[partition], moving)
                for channel, row in rows:
                    yield row, everything[channel]
            case Tick(partition, index, rows_heard):
                memories = site.kind.clocks[partition].memories
                before = [value.get(Value(partition, o, index - 1), nothing) for o in memories]
                received = yield from _received(rows_heard, hear, nothing)
                inputs = np.vstack([moving, *before, *received])
                for output, row_of in enumerate(multiply(ticks[partition], inputs)):
                    value[Value(partition, output, index)] = row_of
    later = [replace(one, index=one.index + schedule.ticks[one.partition]) for one in schedule.carried]
    return np.vstack([moving[:n_x], *(value[one] for one in later)])


def _received(
    rows_heard: Sequence[Sequence[int]], hear: Callable[[int], Matrix | None], nothing: Matrix
) -> Generator[tuple[int, Matrix], None, list[Matrix]]:
    """Add up what each receive hears; yield (−1, nothing) while something isn't sent yet."""
    received = []
    for places in rows_heard:
        total = nothing
        for place in places:
            while (packet := hear(place)) is None:
                yield -1, nothing
            total = total + packet
        received.append(total)
    return received
