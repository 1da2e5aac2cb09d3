"""A picture of the initial state: the bodies of every peer, and the surfaces between them.

Takes: a `Model`.
Gives: `draw_actors`; `Actor`, `ContactLine`, `keep_in_sight` and `widen`, for an animation.
Guarantees: bodies on an axis have one row per peer; those in a plane have one plane per peer, all to one
scale. A rotating body has a bar along its axis, or a box that reaches to its grasp points; a line joins two
bodies between which a force acts. In space the first two coordinates are drawn. Bodies on an axis are not
drawn together with bodies in a plane.
Does not: simulate, or determine the bodies (see `object_shapes`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.output.object_shapes import (
    Disc,
    DrawnBody,
    PeerView,
    SupportLine,
    moves_in_plane,
    positions_of,
    views_of,
)
from apc.output.pictures import colours_of, new_figure, short_legend
from apc.support.optional import need

MM = 1e3
COLUMNS, PANEL, MARGIN = 4, 3.2, 1.0  # planes in a row; inches: of a plane, of title and labels
WIDTH, ROW = 7.0, 0.62  # inches: of a picture of rows, and of a row
HALF = 0.36  # half of a body's height, of the distance of two rows
LARGEST = 11  # mark of a body, in points
BAR = 48  # length of the bar along the axis of a body that turns, in points
ROOM = 0.12  # of what is drawn, around it
THICKNESS = 0.08  # least half width of a box, of its reach


@dataclass(frozen=True, slots=True, eq=False)
class Actor:
    """A body in a picture: its signals `states`, half its width in mm, and its drawing offset `shift`.

    `shift` is a matplotlib Affine2D; `artists` are the drawn elements, the last one the bar along its axis if
    it rotates, by the signals `turning`.
    """

    ax: Any
    states: tuple[str, ...]
    half: float
    row: int
    shift: Any
    artists: tuple[Any, ...]
    turning: tuple[str, ...]
    boxed: bool = False

    def move(self, index: Sequence[float], angle: float = 0.0) -> None:
        """Put it at (d,), in mm, turned by an angle in rad; along an axis it stays in its row."""
        turned = self.shift.clear().rotate(angle) if self.boxed else self.shift.clear()
        turned.translate(index[0], index[1] if len(index) > 1 else self.row)
        if self.turning and not self.boxed:
            self.artists[-1].set_marker(_bar(angle))


@dataclass(frozen=True, slots=True, eq=False)
class ContactLine:
    """The line from a body to the grasp point `arm`, in mm, of another; `line` is its matplotlib artist."""

    holder: Actor
    held: Actor
    arm: tuple[float, ...]
    line: Any

    def draw(self) -> None:
        """Draw the line between the present places of both bodies."""
        arm = (*self.arm, 0.0)[:2] if self.held.boxed else (0.0, 0.0)
        ends = self.holder.shift.transform([(0.0, 0.0)])[0], self.held.shift.transform([arm])[0]
        self.line.set_data(*zip(*ends, strict=True))


def _bar(angle: float) -> tuple[int, int, float]:
    """Return the mark that is a line at an angle in rad from the first axis: rays up and down, turned."""
    return 2, 2, math.degrees(angle) - 90


def draw_actors(model: Model) -> tuple[Any, list[Actor], list[ContactLine]]:
    """Draw the initial state of a model; return the matplotlib Figure, its bodies and lines, to be moved.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    views, plane = views_of(model), moves_in_plane(model)
    axes = _planes(views) if plane else _rows(views)
    names = list(dict.fromkeys(body.name for view in views for body in view.bodies))
    colours = dict(zip(names, colours_of(len(names)), strict=True))
    actors: list[Actor] = []
    lines: list[ContactLine] = []
    for row, (ax, view) in enumerate(zip(axes, views, strict=True)):
        for surface in view.surfaces:
            _draw_surface(ax, surface, row, view.bodies)
        bodies = sorted(view.bodies, key=lambda body: -body.radius)
        for index, body in enumerate(bodies):
            size = max(LARGEST - 2 * index, 7)  # what is covered is seen around what covers it
            arms = [contact.arm for contact in view.contacts if contact.held == body.name]
            actors.append(_actor(ax, view.name, body, arms, row, colours[body.name], size))
        named = dict(zip((body.name for body in bodies), actors[-len(bodies) :], strict=True))
        style = {"color": "k", "linewidth": 1.2, "marker": "o", "markersize": 3, "zorder": 2.5}
        for contact in view.contacts:
            [line] = ax.plot([], [], **style)
            arm = tuple(MM * value for value in contact.arm)
            lines.append(ContactLine(named[contact.holder], named[contact.held], arm, line))
            lines[-1].draw()
    keep_in_sight(axes)
    figure = axes[0].figure
    handles = {actor.artists[0].get_label(): actor.artists[0] for actor in actors}
    style = {"loc": "outside lower center", "ncols": 4, "frameon": False, "fontsize": 8}
    figure.legend(*short_legend([*handles.values()], [*handles]), **style)
    left = model.peers - len(views)
    title = f"{model.name}: initial state" + (f" ({left} more peers not drawn)" if left else "")
    if any(len(body.position) == 3 for view in views for body in view.bodies):
        title += "\nprojection onto the first two coordinates"
    if plane and (alone := _on_an_axis(model)):
        title += f"\nnot drawn (motion along one axis): {', '.join(alone)}"
    figure.suptitle(title, fontsize=11)
    return figure, actors, lines


def _planes(views: Sequence[PeerView]) -> list[Any]:
    """Return an Axes a peer."""
    columns = min(COLUMNS, len(views))
    lines = -(-len(views) // columns)
    size = (PANEL * columns + 1, PANEL * lines + MARGIN)
    figure = new_figure(size)
    axes: list[Any] = figure.subplots(lines, columns, squeeze=False).ravel().tolist()
    for ax in axes[len(views) :]:
        ax.set_visible(False)
    for ax, view in zip(axes, views, strict=False):
        ax.set_title(view.name, fontsize=9)
        ax.set(aspect="equal", xlabel="x[1] [mm]", ylabel="x[2] [mm]")
        ax.grid(linewidth=0.4, alpha=0.5)
    return axes[: len(views)]


def _rows(views: Sequence[PeerView]) -> list[Any]:
    """Return one Axes for all peers, as often as there are peers."""
    size = (WIDTH, ROW * len(views) + MARGIN + 0.3)
    ax = new_figure(size).subplots()
    ax.set(ylim=(len(views) - 0.45, -0.55), xlabel="position [mm]")
    ax.set_yticks(range(len(views)), [view.name for view in views])
    ax.grid(axis="x", linewidth=0.4, alpha=0.5)
    return [ax] * len(views)


def _actor(
    ax: Any,
    peer: str,
    body: DrawnBody,
    arms: Sequence[Sequence[float]],
    row: int,
    colour: Any,
    size: int,
) -> Actor:
    """Draw a body around the origin, shifted to its place; `size` is that of its mark, in points.

    A rotating body with grasp points `arms` (k, 2), in m, is a box that reaches to them.
    """
    patches = need("matplotlib.patches", "plot")
    shift = need("matplotlib.transforms", "plot").Affine2D()
    half, flat = MM * body.radius, len(body.position) == 1
    style = {"markersize": size, "markeredgecolor": "k", "transform": shift + ax.transData}
    x, y, *_ = (*(MM * value for value in body.position), row)
    shift.translate(x, y)
    artists = ax.plot(0, 0, "s" if half else "o", color=colour, label=body.name, **style)
    if half:
        style = {"facecolor": colour, "alpha": 0.35, "edgecolor": "k", "transform": style["transform"]}
        corner, sides = (-half, -HALF), (2 * half, 2 * HALF)
        shape = patches.Rectangle(corner, *sides, **style) if flat else patches.Circle((0, 0), half, **style)
        artists.append(ax.add_patch(shape))
    turning = tuple(f"{peer}.{text}" for text in body.turning if not flat)
    reach = MM * np.abs(arms).max(axis=0) if turning and np.any(arms) else np.zeros(2)
    if reach.any():
        half = max(half, float(np.hypot(*reach)))
        sides = np.maximum(reach, THICKNESS * reach.max())
        box = {"facecolor": colour, "alpha": 0.35, "edgecolor": "k", "transform": shift + ax.transData}
        artists.append(ax.add_patch(patches.Rectangle(-sides, *(2 * sides), **box)))
        shift.clear().rotate(body.angle).translate(x, y)
    elif turning:
        bar = {"markersize": BAR, "markeredgewidth": 3, "transform": shift + ax.transData, "zorder": 1.5}
        artists += ax.plot(0, 0, color=colour, marker=_bar(body.angle), **bar)
    states = tuple(f"{peer}.{state}" for state in body.states[:2])
    return Actor(ax, states, half, row, shift, tuple(artists), turning, bool(reach.any()))


def _draw_surface(ax: Any, surface: Disc | SupportLine, row: int, bodies: Sequence[DrawnBody]) -> None:
    """Draw a fixed disc, or a line; of a plane in space where it meets that of the first body."""
    if isinstance(surface, Disc):
        index = tuple(MM * value for value in surface.centre[:2])
        style = {"facecolor": "0.8", "edgecolor": "0.25", "linewidth": 2}
        ax.add_patch(need("matplotlib.patches", "plot").Circle(index, MM * surface.radius, **style))
        return
    if len(surface.normal) == 1:
        if ax.get_aspect() == "auto":
            ax.plot([MM * surface.offset] * 2, [row - 0.45, row + 0.45], color="0.25", linewidth=3)
        return
    normal = np.array(surface.normal[:2])
    length = float(normal @ normal)
    if not length:
        return  # it lies in the plane that is drawn, before or behind it
    offset = surface.offset - np.dot(surface.normal[2:], bodies[0].position[2:])
    nearest = [
        MM * (np.array(body.position[:2]) + (offset - normal @ body.position[:2]) / length * normal)
        for body in bodies
    ]
    ax.axline(nearest[0], nearest[0] + [-normal[1], normal[0]], color="0.25", linewidth=3)
    ax.update_datalim(nearest)


def keep_in_sight(axes: Sequence[Any]) -> None:
    """Show all that is in the data limits of Axes: of planes the same square of each, else along x."""
    box = need("matplotlib.transforms", "plot").Bbox.union([ax.dataLim for ax in axes])
    sides = np.array([box.width, box.height]) * (0.5 + ROOM)
    plane = axes[0].get_aspect() != "auto"
    half = (sides.max() if plane else sides[0]) or 0.01 * MM  # all in one point: a centimetre around it
    for ax in axes:
        ax.set_xlim((box.x0 + box.x1) / 2 - half, (box.x0 + box.x1) / 2 + half)
        if plane:
            ax.set_ylim((box.y0 + box.y1) / 2 - half, (box.y0 + box.y1) / 2 + half)


def widen(actor: Actor, track: NDArray[np.float64]) -> None:
    """Take into an Axes' data limits all places of a body (rows, d), in mm."""
    for corner in (np.fmin.reduce(track) - actor.half, np.fmax.reduce(track) + actor.half):
        actor.ax.update_datalim([corner if len(corner) > 1 else (*corner, actor.row)])


def _on_an_axis(model: Model) -> list[str]:
    """Return the bodies whose position is a number."""
    positions = [pair for peer_type in model.peer_types for pair in positions_of(peer_type).items()]
    return list(dict.fromkeys(name.rpartition(".")[0] for name, indices in positions if len(indices) == 1))
