"""Selection of the stiffness, delay and loss of a model for a comparison.

Takes: a `Model`, and names given by the user.
Gives: `SweepChoice`, `choose`, `check_over`; `STIFFNESS`, `DELAY`, `LOSS`.
Guarantees: the selection is by structure (units and communication graph), never by names. An ambiguous choice
is left empty.
Does not: vary them (see `parameter_studies.critical_values`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.parameter_names import ParameterRef, find, times_of, unit_of
from apc.frame.parameters import scope_of
from apc.network.nominal_criterion import channel_numbers
from apc.parameter_studies.margins import STIFFNESSES

STIFFNESS, DELAY, LOSS = "stiffness", "delay", "loss"

_LOCATION = SourceLocation("--over")


@dataclass(frozen=True, slots=True)
class SweepChoice:
    """The varied parameter, by its command-line name; "" if none, with the reason in `why`."""

    name: str
    why: str = ""


def check_over(systems: Sequence[Model], over: Iterable[str]) -> None:
    """Refuse a name that is unknown to all models, or that is not a stiffness, delay or loss.

    Parameters
    ----------
    systems
        The models.
    over
        The names given.

    Raises
    ------
    ApcError
        E622 no model has such a parameter, E940 it is another quantity.
    """
    for name in over:
        refused: list[ApcError] = []
        for system in systems:
            try:
                _axis(system, find(system, name, _LOCATION))
            except ApcError as error:
                refused.append(error)
        if len(refused) == len(systems):
            raise refused[0]


def choose(system: Model, over: Sequence[str]) -> dict[str, SweepChoice]:
    """Return the stiffness, delay and loss of a model to be varied.

    Named parameters have priority. By default these are the stiffness of the coupler that receives from
    others, and the delay and loss of its link. If they are computed from other parameters, those are
    returned.

    Parameters
    ----------
    system
        The model.
    over
        Names of the varied parameters; names unknown in this model are ignored.

    Raises
    ------
    ApcError
        E941 the choice is ambiguous.
    """
    named: dict[str, list[str]] = {STIFFNESS: [], DELAY: [], LOSS: []}
    for name in over:
        try:
            free = find(system, name, _LOCATION)
            named[_axis(system, free)].append(free.label)
        except ApcError:
            continue  # it is another model's, see `check_over`
    return {axis: _only(system, axis, named[axis] or _metric(system, axis)) for axis in named}


def _axis(system: Model, free: ParameterRef) -> str:
    """Return the role of a parameter: stiffness, delay or loss."""
    if times_of(system, free.name):
        return DELAY
    if free.name in channel_numbers(system):
        return LOSS
    unit = unit_of(system, free.name)
    if unit in STIFFNESSES:
        return STIFFNESS
    if unit == "s":
        return DELAY
    message = f"{free.label} of {system.name}"
    raise ApcError(
        Diagnostic("E940", _LOCATION, message, "a stiffness, a delay or a loss", f"a quantity in {unit}")
    )


def _metric(system: Model, axis: str) -> list[str]:
    """Return the names that could be meant."""
    received = {
        receive.link
        for peer_type in system.peer_types
        for clock in peer_type.clocks
        for receive in clock.receives
    }
    links = [link for link in system.links if link.name in received]
    if axis == DELAY:
        return _roots(system, [link.delay for link in links], ("s",))
    if axis == LOSS:
        losses = [link.channel.loss for link in links if link.channel is not None]
        return _roots(system, [loss.p for loss in losses if loss is not None], ("1",))
    reception = {
        channel.rpartition(".")[0]
        for peer_type in system.peer_types
        for send in peer_type.sends
        if send.link in received
        for channel in send.channels
    }
    stiff = [parameter.name for parameter in system.parameters if parameter.unit in STIFFNESSES]
    return _roots(system, [name for name in stiff if name.rpartition(".")[0] in reception], STIFFNESSES)


def _roots(system: Model, names: Iterable[str], units: Sequence[str]) -> list[str]:
    """Return the numbers of a unit that some follow from, themselves where they follow from nothing."""
    scope = scope_of(system)
    needed = scope.needed(list(names))
    return [
        name
        for name in scope.holder
        if name in needed - set(scope.formulas) and unit_of(system, name) in units
    ]


def _only(system: Model, axis: str, names: Sequence[str]) -> SweepChoice:
    """Return the one of some names. Raises ApcError E941 if there are several."""
    if len(names) > 1:
        message = f"has {len(names)} numbers that could be compared as its {axis}: {', '.join(names)}"
        raise ApcError(
            Diagnostic("E941", SourceLocation(system.origin.topology), message, hint=f"--over {names[0]}")
        )
    return SweepChoice(names[0]) if names else SweepChoice("", _nothing(system, axis))


def _nothing(system: Model, axis: str) -> str:
    """Return the reason why no parameter of a model is varied."""
    if axis == STIFFNESS:
        return "no stiffness is that of a coupler which hears others (--over NAME takes another)"
    if not system.links:
        return "there is no link"
    if axis == DELAY:
        return "nobody hears others over a link"
    names = " and ".join(link.name for link in system.links)
    return f"no packet can get lost; loss: 0 % written to {names} lets its loss be varied"
