"""Stable regions side by side: several scenes in one panel, several settings in several panels.

Takes: compiled scenes, what each panel sets, and two axes.
Gives: `Panel`, `Panels`; `compare_regions`, `parse_panel`, `parse_vary`, `gain_factor`.
Guarantees: what is multiplied for a comparison at equal gain follows from the scene's equations, and is told.
Does not: draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Unpack

import numpy as np

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.ages import linear_sites
from apc.frame.exchange import build_exchange
from apc.frame.linearize import linearize
from apc.frame.names import Range, times_of
from apc.frame.overrides import Override, apply, parse_override
from apc.frame.parameters import resolve
from apc.option_value import with_last_unit
from apc.regions.axes import PLACE, parse_axes
from apc.regions.overlay import Overlay, overlay_points, parse_overlay
from apc.regions.stable_region import CELLS, Floats, Region, region
from apc.result import PlotStyle, Result
from apc.vary.crossing import Progress

# By what a parameter is moved to see which weights follow it: no round ratio, so that none of them agree.
MOVE = Fraction(19, 13)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One picture: the regions of some scenes with the same settings.

    `gains` are what each region's y is multiplied by in the comparison: 1, or its number of others.
    `overlays` are published conditions as (label, points (k, 2) in SI).
    """

    title: str
    regions: tuple[Region, ...]
    gains: tuple[int, ...]
    overlays: tuple[tuple[str, Floats], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Panels(Result):
    """Regions to be seen together; `normalized` says that y is an effective gain, see `gain_factor`."""

    shown_by = "region_output:panels"

    panels: tuple[Panel, ...]
    normalized: bool

    @property
    def alone(self) -> Region | None:
        """The only region, if it is just one, with nothing laid over it."""
        if len(self.panels) > 1 or self.panels[0].overlays or self.normalized:
            return None
        regions = self.panels[0].regions
        return regions[0] if len(regions) == 1 else None

    def plot(self, **look: Unpack[PlotStyle]) -> Any:
        """Draw all panels, as `look` says; return the matplotlib Figure."""
        return self._drawn(look=look)


def parse_panel(text: str) -> tuple[str, ...]:
    """Read `lan.delay=0 ms, contact.delay=0 ms`: what a panel sets. Raises ApcError E907 if it isn't that."""
    parts = tuple(part.strip() for part in text.split(","))
    if not all(part and "=" in part for part in parts):
        form = '--panel "lan.delay=0 ms, contact.delay=0 ms"'
        raise ApcError(
            Diagnostic("E907", SourceLocation("--panel"), "a panel", "NAME=VALUE, …", text[:80], form)
        )
    return parts


def parse_vary(text: str) -> tuple[tuple[str, ...], ...]:
    """Read `lan.delay=0,8 ms`: a panel a value; a number without a unit takes that of the last.

    Raises
    ------
    ApcError
        E907 it isn't of that form.
    """
    name, equals, values = (part.strip() for part in text.partition("="))
    texts = with_last_unit(values.split(","))
    if not (equals and name and all(texts)):
        form = "--vary lan.delay=0,8 ms"
        raise ApcError(
            Diagnostic("E907", SourceLocation("--vary"), "--vary", "NAME=VALUE,VALUE,…", text[:80], form)
        )
    return tuple((f"{name}={value}",) for value in texts)


# A scene with a panel's settings, its axes, and what its y is multiplied by.
_Work = tuple[Model, tuple[Range, Range], int]


def compare_regions(
    systems: Sequence[Model],
    *,
    x: str | None = None,
    y: str | None = None,
    panels: Sequence[Sequence[str]] = ((),),
    overlays: Sequence[str] = (),
    normalize: bool = False,
    cells: int = CELLS,
    criterion: str | None = None,
    progress: Progress | None = None,
) -> Panels:
    """Find the regions of some scenes with some settings.

    Parameters
    ----------
    systems
        The scenes; the first one's `studies: region:` gives the axes that are left out.
    x, y
        The axes, see `axes.parse_axes`.
    panels
        What each panel sets: `NAME=VALUE` texts.
    overlays
        Published conditions, see `overlay.parse_overlay`; of the first scene.
    normalize
        Whether y is the effective gain: a scene that sums over its others is given y divided by their number,
        so that its coupling is as strong as that of a scene that takes their mean.
    cells, criterion, progress
        See `stable_region.region`.

    Raises
    ------
    ApcError
        As `parse_axes`, `parse_override`, `parse_overlay`, `gain_factor` and `region`.
    """
    # Whatever is wrong is told before anything is computed.
    jobs: list[tuple[str, list[_Work], list[Overlay]]] = []
    for settings in panels:
        work: list[_Work] = []
        for place, original in enumerate(systems):
            system = apply(original, [parse_override(original, text) for text in settings])
            if place and len(systems[0].region) == 2:
                system = replace(system, region=systems[0].region)
            axes = parse_axes(system, x, y)
            _refuse_set(axes, system, settings)
            gain = gain_factor(system, axes[1]) if normalize else 1
            work.append((system, parse_axes(system, x, y, scale=Fraction(gain)), gain))
        jobs.append((", ".join(settings), work, [parse_overlay(work[0][0], text) for text in overlays]))
    result = []
    for title, work, laid in jobs:
        regions = tuple(
            region(system, axes, cells=cells, criterion=criterion, progress=progress)
            for system, axes, _ in work
        )
        first, axes, gain = work[0]
        lines = tuple(
            (overlay.label, overlay_points(first, overlay, *axes) * [1.0, gain]) for overlay in laid
        )
        result.append(Panel(title, regions, tuple(gain for _, _, gain in work), lines))
    return Panels(tuple(result), normalize)


def _refuse_set(axes: Sequence[Range], system: Model, settings: Sequence[str]) -> None:
    """Raise E902 when a panel sets what an axis varies."""
    for text in settings:
        free = parse_override(system, text).free
        for axis in axes:
            all_of_it = free.group in (None, axis.free.group) and axis.free.name == free.name
            if all_of_it or axis.free.name in times_of(system, free.name):
                what = f"{axis.free.label} is on an axis and set for the panel as well"
                raise ApcError(Diagnostic("E902", PLACE, what))


def gain_factor(system: Model, axis: Range) -> int:
    """Return how often a parameter counts: its number of others where it weighs a sum, 1 where a mean.

    With the mean of N − 1 others a peer is pulled as by one of them, with their sum as by all of them: the
    mean is a sum whose gain is divided by N − 1.

    Raises
    ------
    ApcError
        E906 a parameter that weighs both, an operator that is neither, or peers that hear unequally many.
    """
    first = resolve(system)
    value = axis.low + (axis.high - axis.low) * (MOVE - 1)
    second = resolve(apply(system, [Override(axis.free, value)]))
    exchange = build_exchange(system, first.timings)
    numbers: set[int] = set()
    sites = linear_sites(system, first.timings)
    for place, group in enumerate(system.groups):
        built = sites[group.kind]
        if not built.parameters_suffice:
            what = "the scene weighs its others one by one, so that there is no effective gain to compare at"
            raise ApcError(Diagnostic("E906", PLACE, what))
        before, after = (linearize(built, numbers.parameters[place][0]) for numbers in (first, second))
        for partition, tick_a, tick_b in zip(built.kind.clocks, before.ticks, after.ticks, strict=True):
            for column in np.flatnonzero((tick_a.r != tick_b.r).any(axis=0)).tolist():
                receive = partition.receives[column]
                if receive.operator == "mean":
                    numbers.add(1)
                elif exchange.is_complete(receive.link):
                    numbers.add(system.peers - 1)
                else:
                    heard = np.bincount(exchange.arcs(receive.link)[0][:, 1], minlength=system.peers)
                    numbers |= set(heard.tolist())
    if len(numbers) > 1:
        what = f"{axis.free.label} weighs what is heard of {' and '.join(map(str, sorted(numbers)))} others"
        raise ApcError(Diagnostic("E906", PLACE, f"{what}, so that there is no one effective gain"))
    return max(numbers, default=1)
