"""Selection of the stiffness, delay and loss of a model for a comparison.

Takes: a `Model`, and names given by the user.
Gives: `SweepChoice`, `choose`, `check_over`; `STIFFNESS`, `DELAY`, `LOSS`.
Guarantees: the selection is by structure (units and communication graph), never by names. An ambiguous choice
is left empty.
Does not: vary parameters (see `studies.critical_values`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from apc.compiler.compiled import Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.network.nominal_criterion import channel_numbers
from apc.parameter_values.parameter_names import ParameterRef, find, times_of, unit_of
from apc.parameter_values.parameters import scope_of
from apc.studies.margins import STIFFNESSES

STIFFNESS, DELAY, LOSS = "stiffness", "delay", "loss"

_LOCATION = SourceLocation("--over")


@dataclass(frozen=True, slots=True)
class SweepChoice:
    """The varied parameter, by its command-line name; "" if none, with the reason in `why`."""

    name: str
    why: str = ""


def check_over(models: Sequence[Model], over: Iterable[str]) -> None:
    """Raise ApcError for a name that is unknown to all models, or that is not a stiffness, delay or loss.

    Parameters
    ----------
    models
        The models.
    over
        The names given.

    Raises
    ------
    ApcError
        E622 no model has the parameter, E940 the parameter is another quantity.
    """
    for name in over:
        errors: list[ApcError] = []
        for model in models:
            try:
                _axis(model, find(model, name, _LOCATION))
            except ApcError as error:
                errors.append(error)
        if len(errors) == len(models):
            raise errors[0]


def choose(model: Model, over: Sequence[str]) -> dict[str, SweepChoice]:
    """Return the stiffness, delay and loss of a model to be varied.

    Named parameters have priority. The defaults are the stiffness of the coupler that receives from other
    peers, and the delay and loss of its link. If a default is computed from other parameters, these are
    returned instead.

    Parameters
    ----------
    model
        The model.
    over
        Names of the varied parameters; names unknown in this model are ignored.

    Raises
    ------
    ApcError
        E941 the choice is ambiguous.
    """
    names_by_axis: dict[str, list[str]] = {STIFFNESS: [], DELAY: [], LOSS: []}
    for name in over:
        try:
            parameter_ref = find(model, name, _LOCATION)
            names_by_axis[_axis(model, parameter_ref)].append(parameter_ref.label)
        except ApcError:
            continue  # a parameter of another model, see `check_over`
    return {
        axis: _only(model, axis, names_by_axis[axis] or _default_names(model, axis)) for axis in names_by_axis
    }


def _axis(model: Model, parameter_ref: ParameterRef) -> str:
    """Return the role of a parameter: stiffness, delay or loss.

    Raises ApcError (E940) for other quantities.
    """
    if times_of(model, parameter_ref.name):
        return DELAY
    if parameter_ref.name in channel_numbers(model):
        return LOSS
    unit = unit_of(model, parameter_ref.name)
    if unit in STIFFNESSES:
        return STIFFNESS
    if unit == "s":
        return DELAY
    message = f"{parameter_ref.label} of {model.name}"
    raise ApcError(
        Diagnostic("E940", _LOCATION, message, "a stiffness, a delay or a loss", f"a quantity in {unit}")
    )


def _default_names(model: Model, axis: str) -> list[str]:
    """Return the parameters that can be varied by default as the stiffness, delay or loss."""
    received = {
        receive.link
        for peer_type in model.peer_types
        for clock in peer_type.clocks
        for receive in clock.receives
    }
    links = [link for link in model.links if link.name in received]
    if axis == DELAY:
        return _roots(model, [link.delay for link in links], ("s",))
    if axis == LOSS:
        of_links = [link.channel.loss.p for link in links if link.channel and link.channel.loss]
        of_pairs = _losses_of_pairs(links)
        names = _roots(model, of_links or of_pairs, ("1",))
        return names if of_links or len(names) == 1 else []
    receiving_parts = {
        channel.rpartition(".")[0]
        for peer_type in model.peer_types
        for send in peer_type.sends
        if send.link in received
        for channel in send.channels
    }
    stiff = [parameter.name for parameter in model.parameters if parameter.unit in STIFFNESSES]
    return _roots(model, [name for name in stiff if name.rpartition(".")[0] in receiving_parts], STIFFNESSES)


def _losses_of_pairs(links: Iterable[Link]) -> list[str]:
    """Return the loss probabilities of pairs of groups."""
    channels = [pair.channel for link in links for pair in link.pairs]
    return [channel.loss.p for channel in channels if channel and channel.loss]


def _roots(model: Model, names: Iterable[str], units: Sequence[str]) -> list[str]:
    """Return the parameters without formula that determine some parameters, with one of the given units.

    A parameter without formula determines itself.
    """
    scope = scope_of(model)
    needed = scope.needed(list(names))
    return [
        name
        for name in scope.holder
        if name in needed - set(scope.formulas) and unit_of(model, name) in units
    ]


def _only(model: Model, axis: str, names: Sequence[str]) -> SweepChoice:
    """Return the only name, or the reason if there is none. Raises ApcError (E941) for several names."""
    if len(names) > 1:
        message = f"has {len(names)} parameters that could be compared as {axis}: {', '.join(names)}"
        raise ApcError(
            Diagnostic("E941", SourceLocation(model.origin.topology), message, fix=f"--over {names[0]}")
        )
    return SweepChoice(names[0]) if names else SweepChoice("", _nothing(model, axis))


def _nothing(model: Model, axis: str) -> str:
    """Return the reason why no stiffness, delay or loss of a model can be varied."""
    if axis == STIFFNESS:
        return "no stiffness of a coupler between peers (choose another with --over NAME)"
    if not model.links:
        return "there is no link"
    if axis == DELAY:
        return "no peer receives over a link"
    if losses := _losses_of_pairs(model.links):
        return f"several pairs of groups have a loss (choose one with --over {losses[0]})"
    names = " and ".join(link.name for link in model.links)
    return f"no link has a loss; write loss: 0 % at {names} to vary it"
