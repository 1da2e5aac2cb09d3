"""A scene played for the page: a push and what follows of it, and the bodies that move.

Takes: a `CompiledSystem`.
Gives: `Motion`, `Body`, `motion_of`.
Guarantees: rows are those of `simulation`, some of them left out where more are not seen; what grows without
end is shown until it has left the picture, and says so.
Does not: draw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.present.bodies import Disc, moves_in_plane, views_of
from apc.simulation.strike import SPEED, WATCHED, strike
from apc.simulation.trajectory import simulate

Floats = NDArray[np.float64]

# Rows that are shown: more are not seen.
ROWS = 300
# In m: what moves farther than this from where it started has left the picture.
FAR = 1.0
MM = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A body of a peer: where it is (rows,) in mm, along its line or in its plane; `size` is half its width.

    `row` counts the peers that are shown. `angle` (rows,) in rad is that of a body of a plane that turns.
    """

    peer: str
    name: str
    row: int
    x: Floats
    y: Floats | None
    size: float
    angle: Floats | None


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What is seen of a scene: times (rows,) in s, bodies, and what stands still: (row, mm), or discs.

    `told` says it in words; `others` is how many peers are not shown.
    """

    time: Floats
    bodies: tuple[Body, ...]
    walls: tuple[tuple[int, float], ...]
    discs: tuple[tuple[float, float, float], ...]
    told: tuple[str, ...]
    others: int


def motion_of(system: CompiledSystem, *, struck: bool) -> Motion:
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
    told = []
    if struck:
        system, what = strike(system)
        told.append(f"{what} is struck: it starts at {SPEED * MM:g} mm/s.")
    names = [
        f"{view.name}.{state}"
        for view in views
        for body in view.bodies
        for state in (*body.states[:2], *filter(None, [body.turning]))
    ]
    if not names:
        raise ApcError(Mistake("E983", Place(system.name), "nothing here has a position that could be shown"))
    duration = system.experiment.duration or WATCHED
    played = simulate(system, duration=duration, signals=names)
    values, time = played.values, played.time
    places = [number for number, one in enumerate(played.signals) if one.unit == "m"]
    apart = np.abs(values - values[0])[:, places].max(axis=1) > FAR
    if apart.any():
        last = max(int(np.argmax(apart)), 2)
        values, time = values[:last], time[:last]
        told.append(f"Shown until something is {FAR:g} m from where it began.")
    some = np.unique(np.linspace(0, len(time) - 1, min(ROWS, len(time))).astype(int))
    columns = {one.name: values[some, place] for place, one in enumerate(played.signals)}
    found = []
    for row, view in enumerate(views):
        for body in view.bodies:
            x, *rest = (MM * columns[f"{view.name}.{state}"] for state in body.states[:2])
            angle = columns.get(f"{view.name}.{body.turning}")
            found.append(
                Body(view.name, body.name, row, x, rest[0] if rest else None, MM * body.radius, angle)
            )
    fixed = [(row, surface) for row, view in enumerate(views) for surface in view.surfaces]
    told.append(f"It {played.summary.verdict}.")
    return Motion(
        time=time[some],
        bodies=tuple(found),
        walls=tuple((row, MM * one.offset) for row, one in fixed if not planar and not isinstance(one, Disc)),
        discs=tuple(
            dict.fromkeys(
                (MM * one.centre[0], MM * one.centre[1], MM * one.radius)
                for _, one in fixed
                if isinstance(one, Disc)
            )
        ),
        told=tuple(told),
        others=system.peers - len(views),
    )
