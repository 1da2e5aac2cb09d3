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
from apc.lifting.data_age import linear_subsystems
from apc.lifting.numeric_model import numeric_model
from apc.linearization.linearize import linearize
from apc.parameter_values.overrides import Override, apply, parse_override
from apc.parameter_values.parameter_names import Range, times_of
from apc.parameter_values.parameters import resolve
from apc.regions.axes import LOCATION, parse_axes
from apc.regions.stable_region import CELLS, Floats, Region, region
from apc.result import PlotStyle, Result
from apc.studies.crossing import Progress
from apc.support.extension_table import require_extension
from apc.support.option_value import with_last_unit
from apc.timing.communication_graph import build_comm_graph

# The relative position of the second parameter value in a test of dependence: an uncommon ratio.
MOVE = Fraction(19, 13)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One panel of a figure: the regions of some models with the same settings.

    `gains` are the factors on each region's y in the comparison: 1, or the number of other peers. `overlays`
    are published conditions as (label, points (k, 2) in SI).
    """

    title: str
    regions: tuple[Region, ...]
    gains: tuple[int, ...]
    overlays: tuple[tuple[str, Floats], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Panels(Result):
    """The regions of one figure; `normalized` states whether y is an effective gain, see `gain_factor`."""

    shown_by = "region_output:panels"

    panels: tuple[Panel, ...]
    normalized: bool

    @property
    def alone(self) -> Region | None:
        """The only region, None if there are several, or overlays, or a normalization."""
        if len(self.panels) > 1 or self.panels[0].overlays or self.normalized:
            return None
        regions = self.panels[0].regions
        return regions[0] if len(regions) == 1 else None

    def plot(self, **style: Unpack[PlotStyle]) -> Any:
        """Plot all panels in the style `look`; return the matplotlib Figure."""
        return self._plotted(style=style)


def parse_panel(text: str) -> tuple[str, ...]:
    """Return the settings of a panel from a text such as `lan.delay=0 ms, contact.delay=0 ms`."""
    parts = tuple(part.strip() for part in text.split(","))
    if not all(part and "=" in part for part in parts):
        form = '--panel "lan.delay=0 ms, contact.delay=0 ms"'
        raise ApcError(
            Diagnostic("E907", SourceLocation("--panel"), "panel", "NAME=VALUE, …", text[:80], form)
        )
    return parts


def parse_vary(text: str) -> tuple[tuple[str, ...], ...]:
    """Return the settings of panels from a text such as `lan.delay=0,8 ms`, one panel for each value.

    A number without a unit takes the last unit.

    Raises
    ------
    ApcError
        E907 another form of text.
    """
    name, equals, values = (part.strip() for part in text.partition("="))
    texts = with_last_unit(values.split(","))
    if not (equals and name and all(texts)):
        form = "--vary lan.delay=0,8 ms"
        raise ApcError(
            Diagnostic("E907", SourceLocation("--vary"), "--vary", "NAME=VALUE,VALUE,…", text[:80], form)
        )
    return tuple((f"{name}={value}",) for value in texts)


# A model with a panel's settings, its axes, and the factor on its y.
_Work = tuple[Model, tuple[Range, Range], int]


def compare_regions(
    models: Sequence[Model],
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
    """Return the stable regions of some models with some settings, as panels of one figure.

    Parameters
    ----------
    models
        The models; the `studies: region:` of the first gives axes that are not named.
    x, y
        The axes, see `axes.parse_axes`.
    panels
        The settings of each panel: `NAME=VALUE` texts.
    overlays
        Published conditions for the first model, see `overlay.parse_overlay`.
    normalize
        Whether y is the effective gain: in a model that sums over the other peers, y is divided by their
        number, so that the coupling is as strong as in a model with their mean.
    cells, criterion, progress
        See `stable_region.region`.

    Raises
    ------
    ApcError
        As for `parse_axes`, `parse_override`, `parse_overlay`, `gain_factor` and `region`.
    """
    conditions = require_extension("wall_conditions") if overlays else None
    # All errors are reported before any computation.
    jobs: list[tuple[str, list[_Work], list[Any]]] = []
    for settings in panels:
        prepared_models: list[_Work] = []
        for index, original in enumerate(models):
            model = apply(original, [parse_override(original, text) for text in settings])
            if index and len(models[0].region) == 2:
                model = replace(model, region=models[0].region)
            axes = parse_axes(model, x, y)
            _refuse_setting_of_axis(axes, model, settings)
            gain = gain_factor(model, axes[1]) if normalize else 1
            prepared_models.append((model, parse_axes(model, x, y, scale=Fraction(gain)), gain))
        jobs.append(
            (
                ", ".join(settings),
                prepared_models,
                [conditions.parse_overlay(prepared_models[0][0], text) for text in overlays if conditions],
            )
        )
    result = []
    for title, prepared_models, overlays_of_panel in jobs:
        regions = tuple(
            region(numeric_model(model), axes, cells=cells, criterion=criterion, progress=progress)
            for model, axes, _ in prepared_models
        )
        first_model, axes, gain = prepared_models[0]
        overlay_curves = tuple(
            (overlay.label, conditions.overlay_points(first_model, overlay, *axes) * [1.0, gain])
            for overlay in overlays_of_panel
            if conditions
        )
        result.append(Panel(title, regions, tuple(gain for _, _, gain in prepared_models), overlay_curves))
    return Panels(tuple(result), normalize)


def _refuse_setting_of_axis(axes: Sequence[Range], model: Model, settings: Sequence[str]) -> None:
    """Raise E902 if a panel sets the parameter of an axis."""
    for text in settings:
        parameter_ref = parse_override(model, text).free
        for axis in axes:
            same_parameter = (
                parameter_ref.group in (None, axis.free.group) and axis.free.name == parameter_ref.name
            )
            if same_parameter or axis.free.name in times_of(model, parameter_ref.name):
                message = f"{axis.free.label} is both on an axis and set for the panel"
                raise ApcError(Diagnostic("E902", LOCATION, message))


def gain_factor(model: Model, axis: Range) -> int:
    """Return the gain factor of a parameter: the number of other peers for a sum, 1 for a mean.

    The mean over N − 1 other peers is their sum with the gain divided by N − 1. The received values with this
    gain are those whose coefficients in the tick equations change with the parameter.

    Raises
    ------
    ApcError
        E906 a parameter of a sum and a mean, another operator, or peers with unequal numbers of senders.
    """
    numbers_before = resolve(model)
    value = axis.low + (axis.high - axis.low) * (MOVE - 1)
    numbers_after = resolve(apply(model, [Override(axis.free, value)]))
    comm_graph = build_comm_graph(model, numbers_before.timings)
    factors: set[int] = set()
    subsystems = linear_subsystems(model, numbers_before.timings)
    for index, group in enumerate(model.groups):
        subsystem = subsystems[group.peer_type]
        if not subsystem.parameters_suffice:
            message = "the topology has individual weights, so an effective gain is undefined"
            raise ApcError(Diagnostic("E906", LOCATION, message))
        peer_before, peer_after = (
            linearize(subsystem, resolved.parameters[index][0])
            for resolved in (numbers_before, numbers_after)
        )
        for partition, tick_before, tick_after in zip(
            subsystem.peer_type.clocks, peer_before.ticks, peer_after.ticks, strict=True
        ):
            for column in np.flatnonzero((tick_before.r != tick_after.r).any(axis=0)).tolist():
                receive = partition.receives[column]
                if receive.operator == "mean":
                    factors.add(1)
                elif comm_graph.is_complete(receive.link):
                    factors.add(model.peers - 1)
                else:
                    received = np.bincount(comm_graph.arcs(receive.link)[0][:, 1], minlength=model.peers)
                    factors |= set(received.tolist())
    if len(factors) > 1:
        message = (
            f"{axis.free.label} is a weight for {' and '.join(map(str, sorted(factors)))} received peers"
        )
        raise ApcError(Diagnostic("E906", LOCATION, f"{message}, so the effective gain is not unique"))
    return max(factors, default=1)
