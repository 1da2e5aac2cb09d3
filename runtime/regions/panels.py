"""Stable regions of several models in one panel, or of several settings in several panels.

Takes: models, the settings of each panel, and two axes.
Gives: `Panel`, `Panels`; `compare_regions`, `parse_panel`, `parse_vary`, `gain_factor`.
Guarantees: the factors of a comparison at equal gain follow from the model's equations, and are reported.
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
from apc.frame.communication_graph import build_exchange
from apc.frame.data_age import linear_subsystems
from apc.frame.linearize import linearize
from apc.frame.overrides import Override, apply, parse_override
from apc.frame.parameter_names import Range, times_of
from apc.frame.parameters import resolve
from apc.option_value import with_last_unit
from apc.parameter_studies.crossing import Progress
from apc.regions.axes import LOCATION, parse_axes
from apc.regions.overlay import Overlay, overlay_points, parse_overlay
from apc.regions.stable_region import CELLS, Floats, Region, region
from apc.result import PlotStyle, Result

# By what a parameter is moved to see which weights follow it: no round ratio, so that none of them agree.
MOVE = Fraction(19, 13)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One picture: the regions of some models with the same settings.

    `gains` are what each region's y is multiplied by in the comparison: 1, or its number of others.
    `overlays` are published conditions as (label, points (k, 2) in SI).
    """

    title: str
    regions: tuple[Region, ...]
    gains: tuple[int, ...]
    overlays: tuple[tuple[str, Floats], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Panels(Result):
    """Regions of one figure; `normalized` is whether y is an effective gain, see `gain_factor`."""

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

    def plot(self, **style: Unpack[PlotStyle]) -> Any:
        """Plot all panels in the style `look`; return the matplotlib Figure."""
        return self._plotted(style=style)


def parse_panel(text: str) -> tuple[str, ...]:
    """Read `lan.delay=0 ms, contact.delay=0 ms`: the settings of a panel."""
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


# A model with a panel's settings, its axes, and what its y is multiplied by.
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
    """Find the regions of some models with some settings.

    Parameters
    ----------
    systems
        The models; the first one's `studies: region:` gives the axes that are left out.
    x, y
        The axes, see `axes.parse_axes`.
    panels
        The settings of each panel: `NAME=VALUE` texts.
    overlays
        Published conditions, see `overlay.parse_overlay`; of the first model.
    normalize
        Whether y is the effective gain: a model that sums over its others is given y divided by their number,
        so that its coupling is as strong as that of a model that takes their mean.
    cells, criterion, progress
        See `stable_region.region`.

    Raises
    ------
    ApcError
        As `parse_axes`, `parse_override`, `parse_overlay`, `gain_factor` and `region`.
    """
    # All errors are reported before any computation.
    jobs: list[tuple[str, list[_Work], list[Overlay]]] = []
    for settings in panels:
        work: list[_Work] = []
        for index, original in enumerate(systems):
            system = apply(original, [parse_override(original, text) for text in settings])
            if index and len(systems[0].region) == 2:
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
    """Raise E902 when a panel sets the parameter of an axis."""
    for text in settings:
        free = parse_override(system, text).free
        for axis in axes:
            all_of_it = free.group in (None, axis.free.group) and axis.free.name == free.name
            if all_of_it or axis.free.name in times_of(system, free.name):
                message = f"{axis.free.label} is on an axis and set for the panel as well"
                raise ApcError(Diagnostic("E902", LOCATION, message))


def gain_factor(system: Model, axis: Range) -> int:
    """Return the gain factor of a parameter: the number of other peers for a sum, 1 for a mean.

    The mean of N − 1 others is their sum with the gain divided by N − 1.

    Raises
    ------
    ApcError
        E906 a parameter of both, an operator that is neither, or peers with unequal numbers of senders.
    """
    first = resolve(system)
    value = axis.low + (axis.high - axis.low) * (MOVE - 1)
    second = resolve(apply(system, [Override(axis.free, value)]))
    exchange = build_exchange(system, first.timings)
    numbers: set[int] = set()
    subsystems = linear_subsystems(system, first.timings)
    for index, group in enumerate(system.groups):
        built = subsystems[group.peer_type]
        if not built.parameters_suffice:
            message = (
                "the topology weighs its others one by one, so that there is no effective gain to compare at"
            )
            raise ApcError(Diagnostic("E906", LOCATION, message))
        before, after = (linearize(built, numbers.parameters[index][0]) for numbers in (first, second))
        for partition, tick_a, tick_b in zip(built.peer_type.clocks, before.ticks, after.ticks, strict=True):
            for column in np.flatnonzero((tick_a.r != tick_b.r).any(axis=0)).tolist():
                receive = partition.receives[column]
                if receive.operator == "mean":
                    numbers.add(1)
                elif exchange.is_complete(receive.link):
                    numbers.add(system.peers - 1)
                else:
                    received = np.bincount(exchange.arcs(receive.link)[0][:, 1], minlength=system.peers)
                    numbers |= set(received.tolist())
    if len(numbers) > 1:
        message = (
            f"{axis.free.label} weighs what is heard of {' and '.join(map(str, sorted(numbers)))} others"
        )
        raise ApcError(Diagnostic("E906", LOCATION, f"{message}, so that there is no one effective gain"))
    return max(numbers, default=1)
