"""A picture of how a scene begins whose bodies move in a plane or in space: each peer's plane, to scale.

Takes: a `CompiledSystem`; what was recorded of a run.
Gives: `moves_in_plane`, `Spot`, `Disc`, `Line`, `Actor`, `spots_of`, `draw_plane`, `name_in_legend`;
`paths_of`, `draw_paths`; `deciding`, `write_name`.
Guarantees: everything is found in the equations: a body is a vector of positions (states in metres); where
something is decided by the distance of two of them, or of one from a fixed point, in metres, there is a disc;
where by the distance from a line or plane, there is a line. Of space the first two coordinates are drawn.
Does not: play the scene, or know what a part is called; draw bodies that move along one axis beside others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.interpolation import jacobian
from apc.compiler.language.vectors import entry, whole_and_index
from apc.frame.jacobians import guards_of
from apc.optional import need
from apc.present.pictures import colours_of
from apc.simulation.signals import Signal, sent_states

Floats = NDArray[np.float64]

MM = 1e3
COLUMNS, PANEL, MARGIN = 4, 3.2, 0.9  # peers in a row; inches: of a plane, of title and labels
ROOM = 0.15  # of what is drawn, around it
PROBES = 4  # states at which a surface is looked at: a disc in space has four unknowns, and each tells three
SAME = 1e-9  # relative: what is equal but for roundings


@dataclass(frozen=True, slots=True)
class Spot:
    """A body at the start: where it is, in m, and its radius, 0 for a point; `state` is the vector of it."""

    name: str
    place: tuple[float, ...]
    radius: float
    state: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Disc:
    """A fixed disc or sphere, in m."""

    centre: tuple[float, ...]
    radius: float


@dataclass(frozen=True, slots=True)
class Line:
    """Where normal·x = offset, a line or plane; the normal has the length 1, the offset is in m."""

    normal: tuple[float, ...]
    offset: float


@dataclass(frozen=True, slots=True, eq=False)
class Actor:
    """A body in a picture, drawn by matplotlib as a `dot` in `ax` and maybe as a `shape` of half size `half`.

    `states` are the signals that its coordinates are: `user[1].cube.x`, or the first two of a vector.
    """

    ax: Any
    states: tuple[str, ...]
    half: float  # mm
    dot: Any
    shape: Any

    def move(self, place: Sequence[float]) -> None:
        """Put it at (d,), in mm; along a line it stays in its row."""
        if len(place) == 1:
            self.dot.set_xdata(place)
            if self.shape is not None:
                self.shape.set_x(place[0] - self.half)
            return
        self.dot.set_data(place[:1], place[1:])
        if self.shape is not None:
            self.shape.set_center(place)


def name_in_legend(figure: Any, actors: Sequence[Actor]) -> None:
    """Name bodies of a picture below it, each once."""
    handles = {actor.dot.get_label(): actor.dot for actor in actors}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8)


def vectors_of(kind: Kind) -> dict[str, list[int]]:
    """Return the vectors of positions of a kind, each by the places of its entries among the states."""
    found: dict[str, list[int]] = {}
    for place, state in enumerate(kind.states):
        whole, index = whole_and_index(state.name)
        if index and state.unit == "m":
            found.setdefault(whole, []).append(place)
    return found


def moves_in_plane(system: CompiledSystem) -> bool:
    """Return whether some body's position is a vector."""
    return any(map(vectors_of, system.kinds))


def spots_of(
    kind: Kind, vector: Sequence[float], start: Sequence[float]
) -> tuple[list[Spot], list[Disc | Line]]:
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
    bodies = vectors_of(kind)
    radii = dict.fromkeys(bodies, 0.0)
    sent = sent_states(kind)
    fixed: dict[Disc | Line, None] = {}
    for points, values, slopes in _probed(kind, vector):
        moving = set(np.flatnonzero(slopes.any(axis=0)).tolist())
        own = [name for name, places in bodies.items() if moving & set(places)]
        if not 1 <= len(own) <= 2 or not moving <= {i for name in own for i in bodies[name]}:
            continue
        first = slopes[:, bodies[own[0]]]
        at = points[:, bodies[own[0]]]
        if len(own) == 2:
            if not np.allclose(first, -slopes[:, bodies[own[1]]], rtol=0, atol=SAME):
                continue
            at = at - points[:, bodies[own[1]]]
        found = _surface(at, values, first)
        if found is None:
            continue
        if len(own) == 1:
            fixed[found] = None
        elif isinstance(found, Disc) and np.allclose(found.centre, 0, atol=SAME):
            wide = next((name for name in own if bodies[name][0] in sent), own[1])
            radii[wide] = max(radii[wide], found.radius)
    spots = [
        Spot(name.rpartition(".")[0], tuple(float(start[i]) for i in places), radii[name], name)
        for name, places in bodies.items()
    ]
    return spots, list(fixed)


def _surface(at: Floats, values: Floats, slopes: Floats) -> Disc | Line | None:
    """Return where a function of a point is zero, if it is the distance from a disc or a line, with a sign.

    Parameters
    ----------
    at, values, slopes
        Points (k, d), the function there (k,), and its slopes (k, d).
    """
    if not np.allclose(np.linalg.norm(slopes, axis=1), 1, rtol=0, atol=SAME):
        return None
    if np.allclose(slopes, slopes[0], rtol=0, atol=SAME):
        normal = slopes[0] * (1 if slopes[0][np.abs(slopes[0]).argmax()] > 0 else -1)
        offset = float(normal @ at[0] - (normal @ slopes[0]) * values[0])
        return Line(tuple(_tidy(float(one)) for one in normal), _tidy(offset))
    # g = ∓(R − |p − c|) has the slope ±(p − c)/|p − c|: c = p − g·slope ∓ R·slope, the same from every point.
    count, size = at.shape
    system = np.zeros((count * size, size + 1))
    system[:, :size] = np.tile(np.eye(size), (count, 1))
    system[:, size] = slopes.ravel()
    right = (at - values[:, None] * slopes).ravel()
    solution = np.linalg.lstsq(system, right, rcond=None)[0]
    scale = 1 + np.abs(right).max()
    if not np.allclose(system @ solution, right, rtol=0, atol=SAME * scale):
        return None
    return Disc(tuple(_tidy(float(one)) for one in solution[:size]), abs(_tidy(float(solution[size]))))


def _tidy(number: float) -> float:
    """Return a number without its last roundings, so that surfaces told of twice are one."""
    return float(f"{number:.9g}") if abs(number) > SAME else 0.0


def deciding(kind: Kind) -> Iterator[tuple[Any, Any, Any]]:
    """Yield of each function its states, its parameters, and what it decides by on them alone."""
    for function in (kind.derivative, *(one.tick for one in kind.clocks)):
        if not function.is_a("SXFunction"):
            continue
        inputs = function.sx_in()
        x, p = inputs[0], inputs[-2]
        others = casadi.vertcat(*(one for i, one in enumerate(inputs) if i not in (0, len(inputs) - 2)))
        guards = guards_of(casadi.densify(function(*inputs)), x)
        if own := [one for one in guards if not casadi.depends_on(one, others)]:
            yield x, p, casadi.densify(casadi.vertcat(*own))


def write_name(ax: Any, name: str, place: Sequence[float], above: float) -> None:
    """Write a body's name so many points above a place."""
    ax.annotate(
        name,
        place,
        (0, above),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=7,
        bbox={"facecolor": "w", "linewidth": 0, "alpha": 0.7, "pad": 0.5},
    )


def _probed(kind: Kind, vector: Sequence[float]) -> list[tuple[Floats, Floats, Floats]]:
    """Return states (k, n_x) and, for each function that decides something, its values (k,) and slopes."""
    found = []
    points = np.random.default_rng(1).uniform(-1, 1, (PROBES, len(kind.states)))
    for x, p, column in deciding(kind):
        at = casadi.Function("at", [x, p], [column, casadi.densify(jacobian(column, x))])
        numbers = [[np.asarray(one, dtype=np.float64) for one in at(point, vector)] for point in points]
        for row in range(column.numel()):
            values = np.array([value[row, 0] for value, _ in numbers])
            slopes = np.array([slope[row] for _, slope in numbers])
            if np.isfinite(values).all() and np.isfinite(slopes).all():
                found.append((points, values, slopes))
    return found


def draw_plane(
    system: CompiledSystem, rows: Sequence[tuple[str, list[Spot], list[Disc | Line]]], *, named: bool = True
) -> tuple[Any, list[Actor]]:
    """Draw how a scene begins, a plane a peer; return the matplotlib Figure and the bodies in it.

    Parameters
    ----------
    system
        The compiled scene.
    rows
        The peers that are drawn: name, bodies, surfaces.
    named
        Whether a body's name stands beside it; else the names stand in a legend.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures, patches = need("matplotlib.figure", "plot"), need("matplotlib.patches", "plot")
    columns = min(COLUMNS, len(rows))
    lines = -(-len(rows) // columns)
    figure = figures.Figure(figsize=(PANEL * columns + 1, PANEL * lines + MARGIN), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    names = list(dict.fromkeys(spot.name for _, spots, _ in rows for spot in spots))
    low, high = _extent(rows)
    colours, actors = colours_of(len(names)), []
    for ax, (title, spots, surfaces) in zip(axes, rows, strict=False):
        for one in surfaces:
            _draw_surface(ax, one, spots, patches)
        labels: dict[tuple[float, ...], list[str]] = {}
        for spot in sorted(spots, key=lambda one: -one.radius):
            colour = colours[names.index(spot.name)]
            place = tuple(MM * value for value in spot.place[:2])
            shape = None
            if spot.radius:
                look = {"facecolor": colour, "alpha": 0.35, "edgecolor": "k"}
                shape = patches.Circle(place, MM * spot.radius, **look)
                ax.add_patch(shape)
            marker = "s" if spot.radius else "o"
            look = {"color": colour, "markersize": 7, "markeredgecolor": "k", "label": spot.name}
            (dot,) = ax.plot(*place, marker, **look)
            states = tuple(f"{title}.{entry(spot.state, index)}" for index in (1, 2))
            actors.append(Actor(ax, states, MM * spot.radius, dot, shape))
            labels.setdefault(place, []).append(spot.name)
        for place, told in labels.items() if named else ():
            write_name(ax, ", ".join(told), place, 6)
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_aspect("equal")
        ax.set_title(title, fontsize=9)
        ax.grid(visible=True, linewidth=0.4, alpha=0.5)
        ax.set_xlabel("x[1] [mm]")
        ax.set_ylabel("x[2] [mm]")
    for ax in axes[len(rows) :]:
        ax.set_visible(False)
    left = system.peers - len(rows)
    caption = f" ({left} more peers)" if left else ""
    if any(len(spot.place) == 3 for _, spots, _ in rows for spot in spots):
        caption += "\nof three coordinates the first two"
    if alone := _on_a_line(system):
        caption += f"\nnot drawn, as they move along one axis: {', '.join(alone)}"
    figure.suptitle(f"{system.name}: at the start{caption}", fontsize=11)
    if not named:
        name_in_legend(figure, actors)
    return figure, actors


def paths_of(signals: Sequence[Signal]) -> list[tuple[int, int]]:
    """Return which signals are the first two coordinates of one position."""
    found = {(one.group, one.peer, one.local): place for place, one in enumerate(signals) if one.unit == "m"}
    pairs = []
    for (group, peer, local), place in found.items():
        whole, index = whole_and_index(local)
        if index == 1 and (other := found.get((group, peer, entry(whole, 2)))) is not None:
            pairs.append((place, other))
    return pairs


def draw_paths(
    ax: Any, signals: Sequence[Signal], values: Floats, paths: Sequence[tuple[int, int, Any, Any]]
) -> None:
    """Draw the paths of positions in their plane, each from its start, a dot.

    Parameters
    ----------
    ax
        The matplotlib Axes.
    signals, values
        What was recorded (rows, signals), SI.
    paths
        The two signals of each path, its colour and its dashes.
    """
    for one, two, colour, dashes in paths:
        x, y = MM * values[:, one], MM * values[:, two]
        whole, _ = whole_and_index(signals[one].name)
        ax.plot(x, y, color=colour, linestyle=dashes, linewidth=1.0, label=whole)
        ax.plot(x[:1], y[:1], "o", color=colour, markersize=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x[1] [mm]")
    ax.set_ylabel("path: x[2] [mm]")
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)


def _draw_surface(ax: Any, one: Disc | Line, spots: Sequence[Spot], patches: Any) -> None:
    """Draw a fixed disc, or a line; of a plane in space where it meets that of the first body."""
    if isinstance(one, Disc):
        place = tuple(MM * value for value in one.centre[:2])
        ax.add_patch(patches.Circle(place, MM * one.radius, facecolor="0.8", edgecolor="0.25", linewidth=2))
        return
    normal = np.array(one.normal[:2])
    length = float(normal @ normal)
    if not length:
        return  # it lies in the plane that is drawn, before or behind it
    offset = one.offset - sum(n * x for n, x in zip(one.normal[2:], spots[0].place[2:], strict=False))
    through = MM * offset * normal / length
    along = MM * np.array([-normal[1], normal[0]])
    ax.axline(through, through + along, color="0.25", linewidth=3)


def _extent(rows: Sequence[tuple[str, list[Spot], list[Disc | Line]]]) -> tuple[Floats, Floats]:
    """Return the corners (2,) of a square that holds everything of all peers, in mm."""
    points = []
    for _, spots, surfaces in rows:
        round_ = [(spot.place, spot.radius) for spot in spots]
        round_ += [(one.centre, one.radius) for one in surfaces if isinstance(one, Disc)]
        for place, radius in round_:
            points += [np.array(place[:2]) - radius, np.array(place[:2]) + radius]
        for line in (one for one in surfaces if isinstance(one, Line)):
            normal = np.array(line.normal)
            for spot in spots:  # the point of the line that is nearest to a body
                if len(spot.place) == len(normal):
                    near = np.array(spot.place) - (normal @ spot.place - line.offset) * normal
                    points.append(near[:2])
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    half = (high - low).max() * (0.5 + ROOM) or 0.01  # all in one point: a centimetre around it
    middle = (low + high) / 2
    return MM * (middle - half), MM * (middle + half)


def _on_a_line(system: CompiledSystem) -> list[str]:
    """Return the bodies whose position is a number."""
    found = [
        state.name.rpartition(".")[0]
        for kind in system.kinds
        for state in kind.states
        if state.unit == "m" and not whole_and_index(state.name)[1]
    ]
    return list(dict.fromkeys(found))
