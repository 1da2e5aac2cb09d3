"""One frame of many sites of one kind as linear maps, all at once.

Takes: the Jacobians of a kind, a `Schedule`, and the matrices of many sites as rows (see `linearize_rows`).
Gives: `LiftedRows`, `lift_rows`; `compose_rows`, `exponential_rows`, `roundings_of`.
Guarantees: the maps are those of `lift`, to rounding; every matrix comes with a bound on its error, entry by
entry, wider than that of `lift`, as no ball arithmetic is done.
Does not: decide which sites are alike (see `peers`), or close a loop (see `crowds`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT
from apc.frame.jacobians import SiteJacobians
from apc.frame.lift import COEFFICIENT_ROUNDINGS
from apc.frame.linearize import sites_of_rows
from apc.frame.schedule import Act, Propagate, Schedule, Send, Tick, Value
from apc.frame.site import LinearSite, every_matrix, magnitudes

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128

# Sites composed together: their matrices then stay in the cache of a processor.
CHUNK = 2048

# A bound on a frame's rounding errors above this decides nothing: they are estimated then.
HOPELESS = 1e-6

# From so many frames of numbers moved at random by all roundings of a frame at once: SAFE times the largest
# change. A change is nearly a normal number, below 1/SAFE of its standard deviation in one frame of 10, so in
# all of 8 once in 10⁸. Of 46,656 entries (1,080 sites with copies of 10 mg to 1 g, against 80 digits) the
# error was at most a third of this estimate; of two frames, it was beyond it in 49, up to three times.
PERTURBED_FRAMES, SAFE = 8, 8.0

# With ‖X‖ ≤ 1/2 the Taylor series of φ₁ is right to 2^−60 after so many terms: (1/2)^16/17! < 2^−64.
TERMS = 16


@dataclass(frozen=True, slots=True)
class LiftedRows:
    """The one-frame maps of k sites: z⁺ = P z + Q r, s = S z + D r, see `lift.LiftedSite`."""

    z_names: tuple[str, ...]
    frame_s: float
    p: Floats  # (k, n_z, n_z)
    q: Floats  # (k, n_z, n_r)
    s: Floats  # (k, n_s, n_z)
    d: Floats  # (k, n_s, n_r)
    p_error: Floats
    q_error: Floats
    s_error: Floats
    d_error: Floats
    estimated: bool = False  # the errors of some site are an estimate, as the bound says nothing


def lift_rows(site: SiteJacobians, schedule: Schedule, rows: Floats) -> LiftedRows:
    """Compose the events of a frame for many sites of one kind and schedule.

    Parameters
    ----------
    site
        The kind's Jacobians.
    schedule
        What happens in a frame.
    rows
        The sites' matrices (k, …), from `linearize_rows`.

    Notes
    -----
    As in `lift`, errors multiply along the composition of magnitudes; a step of `exponential_rows` counts
    with the roundings it reports. Where stiffness and damping nearly cancel over many ticks that grows
    without measure, whatever the errors are: beyond `HOPELESS` they are estimated, see `_perturbed`.
    """
    n_z = len(site.kind.states) + len(schedule.carried)
    durations = sorted({event.duration for event in schedule.events if isinstance(event, Propagate)})
    parts: list[tuple[Floats, Floats, Floats, Floats]] = []
    estimated = False
    for start in range(0, len(rows), CHUNK):
        many = sites_of_rows(site, rows[start : start + CHUNK])
        steps, sizes, charges = {}, {}, {}
        for duration in durations:
            steps[duration], sizes[duration], charges[duration] = exponential_rows(
                many.a, many.b, float(duration * schedule.quantum)
            )
        z, s = compose_rows(many, schedule, steps)
        z_large, s_large = compose_rows(magnitudes(many), schedule, sizes)
        roundings = roundings_of(many, schedule, charges)
        gamma = roundings * UNIT / (1 - roundings * UNIT)
        errors = gamma * z_large, gamma * s_large
        lost = {duration: charges[duration] * UNIT * size for duration, size in sizes.items()}
        if not all(float(one.max(initial=0.0)) <= HOPELESS for one in errors):
            errors, estimated = _perturbed(many, schedule, (steps, lost), (z, s), roundings), True
        parts.append((z, s, *errors))
    z, s, z_error, s_error = (np.concatenate(part) for part in zip(*parts, strict=True))
    return LiftedRows(
        z_names=(*(state.name for state in site.kind.states), *schedule.value_names),
        frame_s=float(schedule.frame_s),
        p=z[..., :n_z],
        q=z[..., n_z:],
        s=s[..., :n_z],
        d=s[..., n_z:],
        p_error=z_error[..., :n_z],
        q_error=z_error[..., n_z:],
        s_error=s_error[..., :n_z],
        d_error=s_error[..., n_z:],
        estimated=estimated,
    )


def _perturbed(
    site: LinearSite,
    schedule: Schedule,
    steps: tuple[Mapping[int, Matrix], Mapping[int, Matrix]],
    frame: tuple[Matrix, Matrix],
    size: float,
) -> tuple[Floats, Floats]:
    """Estimate a frame's rounding errors: how much it moves when every number it is made of moves a little.

    Parameters
    ----------
    site, schedule, steps
        What the frame is composed of; the steps with what their exponentials may be off by.
    frame
        The frame as it came out.
    size
        All its roundings, in units of UNIT: by so much each number is moved, at random.
    """
    random = np.random.default_rng(len(schedule.events))

    def moved(matrix: Matrix, by: Matrix | float = 0.0) -> Matrix:
        most = size * UNIT * np.abs(matrix) + by
        return np.asarray(matrix + most * random.uniform(-1, 1, matrix.shape))

    errors = [size * UNIT * np.abs(one) for one in frame]
    for _ in range(PERTURBED_FRAMES):
        other = compose_rows(
            every_matrix(site, moved),
            schedule,
            {duration: moved(step, steps[1][duration]) for duration, step in steps[0].items()},
        )
        errors = [np.maximum(e, SAFE * np.abs(a - b)) for e, a, b in zip(errors, frame, other, strict=True)]
    return errors[0], errors[1]


def roundings_of(site: LinearSite, schedule: Schedule, charges: Mapping[int, float]) -> float:
    """Return the roundings of all events of a frame, in units of UNIT."""
    size = sum(site.b.shape[-2:])
    width = size + max((tick.m.shape[-1] + tick.r.shape[-1] for tick in site.ticks), default=0)
    width += len(schedule.heard)
    return sum(
        size + 1 + charges[event.duration] if isinstance(event, Propagate) else width + COEFFICIENT_ROUNDINGS
        for event in schedule.events
        if not isinstance(event, Act)
    )


def exponential_rows(a: Matrix, b: Matrix, seconds: float) -> tuple[Matrix, Floats, float]:
    """Return exp of many generators by scaling and squaring, x(t + T) = F x(t) + G u.

    Parameters
    ----------
    a, b
        A (k, n_x, n_x) and B (k, n_x, n_u), float64 or complex128, each entry right to
        `COEFFICIENT_ROUNDINGS` roundings.
    seconds
        T.

    Returns
    -------
    [F G] (k, n_x, n_x + n_u), sizes of that shape, and a number c of roundings: the true entries lie within
    c·UNIT times their size.

    Notes
    -----
    With X = A T/2^s, ‖X‖ ≤ 1/2, and Y = φ₁(X) by Horner's rule, F = I + X Y and G = Y B T/2^s; then
    s times F ← F², G ← F G + G. A rounding at the j-th step of Horner's rule reaches Y through X^(j−1)/j!,
    so that all of them together stay below n + 3 roundings of φ₁ of the magnitudes twice as large.
    """
    n_x, n_u = b.shape[-2:]
    x = a * seconds
    norm = float(np.abs(x).sum(axis=-2).max(initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(norm))) + 1) if 0 < norm < np.inf else 0
    x, g = x * 2.0**-squarings, b * (seconds * 2.0**-squarings)
    phi, large = _phi(x), _phi(2 * np.abs(x))
    step = np.concatenate([np.eye(n_x) + x @ phi, phi @ g], axis=-1)
    charge = float(n_x + 6 + 2 * COEFFICIENT_ROUNDINGS)
    doubled = np.concatenate([np.eye(n_x) + 2 * np.abs(x) @ large, large @ np.abs(g)], axis=-1)
    error = (charge * UNIT) * doubled
    below = np.broadcast_to(np.eye(n_x + n_u)[n_x:], (*b.shape[:-2], n_u, n_x + n_u))
    for _ in range(squarings):
        whole, off = np.concatenate([step, below], axis=-2), np.concatenate([error, 0 * below], axis=-2)
        size = np.abs(whole)
        error = (size[..., :n_x, :] + error) @ off + error @ size
        error += (n_x + 2) * UNIT * (size[..., :n_x, :] @ size)
        step = step @ whole
    return step, np.maximum(np.abs(step), error / (charge * UNIT)), charge


def _phi(x: Matrix) -> Matrix:
    """Return φ₁(X) = I + X/2! + X²/3! + … of many small matrices."""
    unit = np.eye(x.shape[-1])
    found = unit + 0 * x
    for term in range(TERMS, 0, -1):
        found = unit + (x / (term + 1)) @ found
    return np.asarray(found)


def compose_rows(site: LinearSite, schedule: Schedule, steps: Mapping[int, Matrix]) -> tuple[Matrix, Matrix]:
    """Follow z and r of many sites through one frame.

    Parameters
    ----------
    site
        Their matrices, with a leading axis (k).
    schedule
        What happens in a frame.
    steps
        [F G] (k, n_x, n_x + n_u) by duration in quanta.

    Returns
    -------
    z⁺ (k, n_z, n_z + n_r) and s (k, n_s, n_z + n_r), every row over the columns (z, r).
    """
    kind, many = site.kind, len(site.a)
    n_x, n_u, n_r = len(kind.states), len(kind.holds), len(schedule.heard)
    n_z = n_x + len(schedule.carried)
    unit = np.eye(n_z + n_r)
    nothing = np.zeros(n_z + n_r)
    value: dict[Value, Matrix] = {one: unit[n_x + row] for row, one in enumerate(schedule.carried)}
    heard = unit[n_z:]
    moving = np.zeros((many, n_x + n_u, n_z + n_r), dtype=site.a.dtype)
    moving[:, :n_x] = unit[:n_x]
    for hold, one in enumerate(schedule.acting):
        moving[:, n_x + hold] = value.get(one, nothing) if one is not None else nothing
    sends = [np.concatenate([send.x, send.u], axis=-1) for send in site.sends]
    ticks = [
        (np.concatenate([tick.x, tick.u], axis=-1), np.concatenate([tick.m, tick.r], axis=-1))
        for tick in site.ticks
    ]
    sent = np.zeros((many, len(schedule.sent), n_z + n_r), dtype=site.a.dtype)
    for event in schedule.events:
        match event:
            case Propagate(duration):
                moving[:, :n_x] = steps[duration] @ moving
            case Act(hold, one):
                moving[:, n_x + hold] = value.get(one, nothing)
            case Send(partition, rows):
                everything = sends[partition] @ moving
                for channel, row in rows:
                    sent[:, row] = everything[:, channel]
            case Tick(partition, index, rows_heard):
                memories = kind.clocks[partition].memories
                before = [value.get(Value(partition, o, index - 1), nothing) for o in memories]
                received = [heard[list(rows)].sum(axis=0) for rows in rows_heard]
                of_motion, of_rest = ticks[partition]
                computed = of_motion @ moving
                for column, row_of in enumerate([*before, *received]):
                    computed += of_rest[:, :, column, None] * (
                        row_of[:, None, :] if row_of.ndim == 2 else row_of
                    )
                for output in range(computed.shape[1]):
                    value[Value(partition, output, index)] = computed[:, output]
    after = [
        value[Value(one.partition, one.output, one.index + schedule.ticks[one.partition])]
        for one in schedule.carried
    ]
    kept = [np.broadcast_to(row, (many, n_z + n_r))[:, None] for row in after]
    return np.concatenate([moving[:, :n_x], *kept], axis=1), sent
