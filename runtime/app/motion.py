"""Simulation for the page: response to an impulse or to start values, and the moving bodies.

Takes: a `Model`.
Gives: `AnimationFrames`, `motion_of`.
Guarantees: rows are rows of `simulation`, thinned to the visible resolution. A diverging motion is shown
until it leaves the figure, with a remark.
Does not: draw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.output.object_shapes import Disc, DrawnBody, heading, moves_in_plane, views_of
from apc.simulation.initial_velocity import WATCHED, impulse_text, initial_velocity
from apc.simulation.trajectory import simulate

Floats = NDArray[np.float64]

# The largest number of rows shown; more are not visible.
ROWS = 300
# The displacement in m at which a body leaves the picture.
FAR = 1.0
MM = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class AnimationFrames:
    """The visible part of a motion: times (rows,) in s, n bodies, and fixed surfaces: walls (row, mm),
    or discs.

    `x`, `y` and `angle` (rows, n) are the positions of the bodies in mm and rad; `y` is None if all move
    along lines, one line per peer. `bodies` are the peers and the shapes of the bodies; `contacts` are pairs
    of bodies, with the grasp point along the axes of the second in mm. `remarks` is the text alternative;
    `others` is the number of peers not shown.
    """

    time: Floats
    bodies: tuple[tuple[str, DrawnBody], ...]
    contacts: tuple[tuple[int, int, tuple[float, float]], ...]
    x: Floats
    y: Floats | None
    angle: Floats
    walls: tuple[tuple[int, float], ...]
    discs: tuple[tuple[float, float, float], ...]
    remarks: tuple[str, ...]
    others: int


def motion_of(model: Model, *, struck: bool) -> AnimationFrames:
    """Return the simulated motion of a model: from its start values, optionally with an impulse at the
    first peer.

    Parameters
    ----------
    model
        The model.
    struck
        Whether the first peer's device has an impulse at the start.

    Raises
    ------
    ApcError
        E983 no device for the impulse, or no position to show; and the errors of `trajectory.simulate`.
    """
    planar = moves_in_plane(model)
    views = views_of(model)
    remarks = []
    if struck:
        model, subject = initial_velocity(model)
        remarks.append(impulse_text(subject))
    shown = tuple((view.name, body) for view in views for body in view.bodies)
    indices_of = {(peer, body.name): index for index, (peer, body) in enumerate(shown)}
    contacts = tuple(
        (
            indices_of[view.name, contact.holder],
            indices_of[view.name, contact.held],
            (MM * contact.arm[0], MM * contact.arm[1] if planar else 0.0),
        )
        for view in views
        for contact in view.contacts
    )
    names = [
        [f"{peer}.{state}" for state in (body.states[0], body.states[planar], *body.turning)]
        for peer, body in shown
    ]
    if not names:
        raise ApcError(Diagnostic("E983", SourceLocation(model.name), "the topology has no position to show"))
    duration = model.experiment.duration or WATCHED
    simulated = simulate(model, duration=duration, signals=[text for name in names for text in name])
    values, time = simulated.values, simulated.time
    indices = [number for number, signal in enumerate(simulated.signals) if signal.unit == "m"]
    distances = np.abs(values - np.nan_to_num(values[0]))  # NaN at absent peers
    left_picture = np.fmax.reduce(distances[:, indices], axis=1) > FAR
    if left_picture.any():
        last = max(int(np.argmax(left_picture)), 2)
        values, time = values[:last], time[:last]
        remarks.append(f"Shown until a displacement of {FAR:g} m.")
    row_indices = np.unique(np.linspace(0, len(time) - 1, min(ROWS, len(time))).astype(int))
    columns = {signal.name: index for index, signal in enumerate(simulated.signals)}
    tracks = [values[row_indices][:, [columns[text] for text in name]] for name in names]
    x, y = (np.stack([track[:, index] for track in tracks], axis=1) for index in (0, 1))
    angle = np.stack([heading(track[:, 2:]) for track in tracks], axis=1)
    fixed = [(row, surface) for row, view in enumerate(views) for surface in view.surfaces]
    remarks.append(f"Motion: {simulated.summary.verdict}.")
    return AnimationFrames(
        time=time[row_indices],
        bodies=shown,
        contacts=contacts,
        x=MM * x,
        y=MM * y if planar else None,
        angle=angle,
        walls=tuple(
            (row, MM * line.offset) for row, line in fixed if not planar and not isinstance(line, Disc)
        ),
        discs=tuple(
            dict.fromkeys(
                (MM * disc.centre[0], MM * disc.centre[1], MM * disc.radius)
                for _, disc in fixed
                if isinstance(disc, Disc)
            )
        ),
        remarks=tuple(remarks),
        others=model.peers - len(views),
    )
