"""A scene played for the page: a push and what follows of it, and the bodies that move.

Takes: a `Model`.
Gives: `AnimationFrames`, `motion_of`.
Guarantees: rows are those of `simulation`, some of them left out where more are not seen; what grows without
end is shown until it has left the picture, and says so.
Does not: draw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.present.bodies import Disc, DrawnBody, heading, moves_in_plane, views_of
from apc.simulation.strike import WATCHED, impulse_text, strike
from apc.simulation.trajectory import simulate

Floats = NDArray[np.float64]

# Rows that are shown: more are not seen.
ROWS = 300
# In m: what moves farther than this from where it started has left the picture.
FAR = 1.0
MM = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class AnimationFrames:
    """What is seen of a scene: times (rows,) in s, n bodies, and what stands still: (row, mm), or discs.

    `x`, `y` and `angle` (rows, n) are where each body is, in mm and rad; `y` is None where all move along
    lines, a row a peer. `bodies` are their peers and what they are at the start. `remarks` say it in words;
    `others` is how many peers are not shown.
    """

    time: Floats
    bodies: tuple[tuple[str, DrawnBody], ...]
    x: Floats
    y: Floats | None
    angle: Floats
    walls: tuple[tuple[int, float], ...]
    discs: tuple[tuple[float, float, float], ...]
    remarks: tuple[str, ...]
    others: int


def motion_of(system: Model, *, struck: bool) -> AnimationFrames:
    """Play a scene: as it begins, or with the first peer's device struck besides.

    Parameters
    ----------
    system
        The compiled scene.
    struck
        Whether the first peer's device is struck as it begins.

    Raises
    ------
    ApcError
        E983 nothing to strike or to see; those of `trajectory.simulate`.
    """
    planar = moves_in_plane(system)
    views = views_of(system)
    remarks = []
    if struck:
        system, what = strike(system)
        remarks.append(impulse_text(what))
    shown = tuple((view.name, body) for view in views for body in view.bodies)
    names = [
        [f"{peer}.{state}" for state in (body.states[0], body.states[planar], *body.turning)]
        for peer, body in shown
    ]
    if not names:
        raise ApcError(
            Diagnostic("E983", SourceLocation(system.name), "nothing here has a position that could be shown")
        )
    duration = system.experiment.duration or WATCHED
    played = simulate(system, duration=duration, signals=[text for name in names for text in name])
    values, time = played.values, played.time
    places = [number for number, signal in enumerate(played.signals) if signal.unit == "m"]
    apart = np.abs(values - values[0])[:, places].max(axis=1) > FAR
    if apart.any():
        last = max(int(np.argmax(apart)), 2)
        values, time = values[:last], time[:last]
        remarks.append(f"Shown until something is {FAR:g} m from where it began.")
    texts = np.unique(np.linspace(0, len(time) - 1, min(ROWS, len(time))).astype(int))
    columns = {signal.name: place for place, signal in enumerate(played.signals)}
    tracks = [values[texts][:, [columns[text] for text in name]] for name in names]
    x, y = (np.stack([track[:, place] for track in tracks], axis=1) for place in (0, 1))
    angle = np.stack([heading(track[:, 2:]) for track in tracks], axis=1)
    fixed = [(row, surface) for row, view in enumerate(views) for surface in view.surfaces]
    remarks.append(f"Motion: {played.summary.verdict}.")
    return AnimationFrames(
        time=time[texts],
        bodies=shown,
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
        others=system.peers - len(views),
    )
