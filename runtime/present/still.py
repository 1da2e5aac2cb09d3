"""A picture of how a scene begins: every peer's bodies side by side, and the surfaces between them.

Takes: a `CompiledSystem`. Gives: `Body`, `Wall`, `bodies_of`, `rows_of`, `draw_still`, `save_still`, and
`draw_actors`, the same picture with what moves in it (see `animation`); of bodies that move in a plane that
of `planar`.
Guarantees: everything is found in the equations: a body is a position (a state in metres); where something is
decided by the distance of two of them, or of one from a fixed place, in metres, there is a surface.
Does not: play the scene, or know what a part is called.

A decision on x_a − x_b + w, as a contact takes, says that the two touch at the distance w. The body that is
sent to the others, or else the second, is drawn with a half width of w, the other as a point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.interpolation import jacobian
from apc.compiler.timings import part
from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.frame.start import start_values
from apc.optional import need
from apc.present.pictures import check_format, colours_of, write_figure
from apc.present.planar import (
    MM,
    Actor,
    deciding,
    draw_plane,
    moves_in_plane,
    name_in_legend,
    spots_of,
    write_name,
)
from apc.simulation.signals import sent_states

Floats = NDArray[np.float64]

MOST_PEERS = 12  # drawn: more rows can't be told apart
HEIGHT = 0.36  # half of a body's, of the distance of two rows
WIDTH, ROW, MARGIN, DPI_POINTS = 7.0, 0.62, 1.1, 7.0  # inches: of the figure, a row, title and axis; points


@dataclass(frozen=True, slots=True)
class Body:
    """A position of a peer at the start, in m, half its width, 0 for a point, and the `state` it is."""

    name: str
    place: float
    half_width: float
    state: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Wall:
    """A fixed place, in m, that something is decided by."""

    place: float


B = TypeVar("B")  # bodies and surfaces, on a line or in a plane
S = TypeVar("S")


def bodies_of(kind: Kind, vector: Sequence[float], start: Sequence[float]) -> tuple[list[Body], list[Wall]]:
    """Return what a peer's start looks like.

    Parameters
    ----------
    kind
        The peer's kind.
    vector
        Its parameters (n_p,), SI.
    start
        Its states at the start (n_x,), SI.
    """
    places = [i for i, state in enumerate(kind.states) if state.unit == "m"]
    widths = dict.fromkeys(places, 0.0)
    sent = sent_states(kind)
    walls: dict[float, None] = {}
    for slopes, offset in _distances(kind, vector):
        moving = np.flatnonzero(slopes).tolist()
        if not set(moving) <= set(places) or not (np.abs(slopes[moving]) == 1).all():
            continue  # decided by something else than a distance
        if len(moving) == 1:
            walls[float(-offset / slopes[moving[0]])] = None
        elif len(moving) == 2 and slopes.sum() == 0:
            wide = next((i for i in moving if i in sent), moving[1])
            widths[wide] = max(widths[wide], abs(float(offset)))
    names = [kind.states[i].name for i in places]
    bodies = [
        Body(name.rpartition(".")[0], float(start[i]), widths[i], name)
        for i, name in zip(places, names, strict=True)
    ]
    return bodies, [Wall(place) for place in walls]


def _distances(kind: Kind, vector: Sequence[float]) -> list[tuple[Floats, float]]:
    """Return the slopes (n_x,) and the value at the origin of what decides, where that is linear."""
    found = []
    for x, p, column in deciding(kind):
        slopes = jacobian(column, x)
        at = casadi.Function("at", [x, p], [casadi.densify(slopes), column])
        numbers = [np.asarray(one, dtype=np.float64) for one in at(np.zeros(x.shape), vector)]
        found += [
            (numbers[0][row], float(numbers[1][row, 0]))
            for row in range(column.numel())
            if not casadi.depends_on(slopes[row, :], x)
        ]
    return found


def draw_still(system: CompiledSystem) -> Any:
    """Draw how a scene begins, a row a peer; return the matplotlib Figure.

    Parameters
    ----------
    system
        The compiled scene.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figure, _ = draw_actors(system)
    return figure


def draw_actors(system: CompiledSystem, *, named: bool = True) -> tuple[Any, list[Actor]]:
    """Draw how a scene begins as `draw_still`; return the Figure and the bodies in it, which can be moved.

    Parameters
    ----------
    system
        The compiled scene.
    named
        Whether a body's name stands beside it; else the names stand in a legend.
    """
    figures, patches = need("matplotlib.figure", "plot"), need("matplotlib.patches", "plot")
    if moves_in_plane(system):
        return draw_plane(system, rows_of(system, spots_of), named=named)
    rows = rows_of(system, bodies_of)
    figure = figures.Figure(figsize=(WIDTH, ROW * len(rows) + MARGIN), layout="constrained")
    ax = figure.subplots()
    names = list(dict.fromkeys(body.name for _, bodies, _ in rows for body in bodies))
    actors = []
    colours = colours_of(len(names))
    for y, (peer, bodies, walls) in enumerate(rows):
        for wall in walls:
            ax.plot([MM * wall.place] * 2, [y - 0.45, y + 0.45], color="0.25", linewidth=3)
        for body in sorted(bodies, key=lambda one: -one.half_width):
            colour = colours[names.index(body.name)]
            shape = None
            if body.half_width:
                corner = (MM * (body.place - body.half_width), y - HEIGHT)
                size = (2 * MM * body.half_width, 2 * HEIGHT)
                shape = patches.Rectangle(corner, *size, facecolor=colour, alpha=0.35, edgecolor="k")
                ax.add_patch(shape)
            marker = "s" if body.half_width else "o"
            look = {"color": colour, "markersize": DPI_POINTS, "markeredgecolor": "k", "label": body.name}
            (dot,) = ax.plot(MM * body.place, y, marker, **look)
            actors.append(Actor(ax, (f"{peer}.{body.state}",), MM * body.half_width, dot, shape))
            if not named:
                continue
            above = HEIGHT if body.half_width else 0.12
            write_name(ax, body.name, (MM * body.place, y - above), 2)
    ax.set_ylim(len(rows) - 0.45, -0.55)
    ax.set_yticks(range(len(rows)), [name for name, _, _ in rows])
    ax.margins(x=0.08)
    ax.grid(visible=True, axis="x", linewidth=0.4, alpha=0.5)
    ax.set_xlabel("position [mm]")
    left = system.peers - len(rows)
    ax.set_title(f"{system.name}: at the start" + (f" ({left} more peers)" if left else ""), fontsize=11)
    if not named:
        name_in_legend(figure, actors)
    return figure, actors


def rows_of(
    system: CompiledSystem,
    seen: Callable[[Kind, Sequence[float], Sequence[float]], tuple[list[B], list[S]]],
) -> list[tuple[str, list[B], list[S]]]:
    """Return the peers that are drawn: name, and the bodies and surfaces that are seen of its start.

    Parameters
    ----------
    system
        The compiled scene.
    seen
        `bodies_of`, or `planar.spots_of` of what moves in a plane.
    """
    numbers = resolve(system)
    sites = [jacobians(kind) for kind in system.kinds]
    found: list[tuple[str, list[B], list[S]]] = []
    for group, one in enumerate(system.groups):
        for peer in range(min(one.count, MOST_PEERS - len(found))):
            vector = [float(v) for v in numbers.parameters[group][numbers.rows[group][peer]]]
            start, _, _ = start_values(sites[one.kind], vector)
            found.append((f"{one.name}[{peer + 1}]", *seen(system.kinds[one.kind], vector, start)))
    return found


@part("draw")
def save_still(system: CompiledSystem, path: Path) -> None:
    """Draw how a scene begins into a file, its format chosen by the suffix.

    Raises
    ------
    ApcError
        E878 no such format, E601 it can't be written, E875 matplotlib is not installed.
    """
    check_format(path, "--still")
    write_figure(draw_still(system), path)
