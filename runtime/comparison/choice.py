"""Which stiffness, delay and loss of a scene a comparison looks at.

Takes: a `Model`, and names that a person gave.
Gives: `SweepChoice`, `choose`, `check_over`; `STIFFNESS`, `DELAY`, `LOSS`.
Guarantees: found by structure (units, and who hears whom), never by what a part is called; where several
could be meant, none is taken.
Does not: vary them (see `vary.critical_values`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.names import ParameterRef, find, times_of, unit_of
from apc.frame.parameters import scope_of
from apc.network.nominal import channel_numbers
from apc.vary.margins import STIFFNESSES

STIFFNESS, DELAY, LOSS = "stiffness", "delay", "loss"

_PLACE = SourceLocation("--over")


@dataclass(frozen=True, slots=True)
class SweepChoice:
    """What is varied, under the name that a command takes; "" where nothing is, and then `why`."""

    name: str
    why: str = ""


def check_over(systems: Sequence[Model], over: Iterable[str]) -> None:
    """Refuse a name that no scene knows, or that is no stiffness, delay or loss.

    Parameters
    ----------
    systems
        The compiled scenes.
    over
        The names given.

    Raises
    ------
    ApcError
        E622 no scene has such a parameter, E940 it is another quantity.
    """
    for name in over:
        refused: list[ApcError] = []
        for system in systems:
            try:
                _axis(system, find(system, name, _PLACE))
            except ApcError as error:
                refused.append(error)
        if len(refused) == len(systems):
            raise refused[0]


def choose(system: Model, over: Sequence[str]) -> dict[str, SweepChoice]:
    """Return which stiffness, delay and loss of a scene are varied.

    Those that are named; else the stiffness of the coupler that hears others, the delay of the link over
    which it does, and the loss of that; the numbers that these follow from, where they follow from others.

    Parameters
    ----------
    system
        The compiled scene.
    over
        Names of what is to be varied; those that this scene has not are left aside.

    Raises
    ------
    ApcError
        E941 several could be meant.
    """
    named: dict[str, list[str]] = {STIFFNESS: [], DELAY: [], LOSS: []}
    for name in over:
        try:
            free = find(system, name, _PLACE)
            named[_axis(system, free)].append(free.label)
        except ApcError:
            continue  # it is another scene's, see `check_over`
    return {axis: _only(system, axis, named[axis] or _found(system, axis)) for axis in named}


def _axis(system: Model, free: ParameterRef) -> str:
    """Return what a parameter is. Raises ApcError E940 if it is nothing that is compared."""
    if times_of(system, free.name):
        return DELAY
    if free.name in channel_numbers(system):
        return LOSS
    unit = unit_of(system, free.name)
    if unit in STIFFNESSES:
        return STIFFNESS
    if unit == "s":
        return DELAY
    what = f"{free.label} of {system.name}"
    raise ApcError(
        Diagnostic("E940", _PLACE, what, "a stiffness, a delay or a loss", f"a quantity in {unit}")
    )


def _found(system: Model, axis: str) -> list[str]:
    """Return the names that could be meant."""
    heard = {receive.link for kind in system.kinds for clock in kind.clocks for receive in clock.receives}
    links = [link for link in system.links if link.name in heard]
    if axis == DELAY:
        return _roots(system, [link.delay for link in links], ("s",))
    if axis == LOSS:
        losses = [link.channel.loss for link in links if link.channel is not None]
        return _roots(system, [loss.p for loss in losses if loss is not None], ("1",))
    hearing = {
        channel.rpartition(".")[0]
        for kind in system.kinds
        for send in kind.sends
        if send.link in heard
        for channel in send.channels
    }
    stiff = [parameter.name for parameter in system.parameters if parameter.unit in STIFFNESSES]
    return _roots(system, [name for name in stiff if name.rpartition(".")[0] in hearing], STIFFNESSES)


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
        what = f"has {len(names)} numbers that could be compared as its {axis}: {', '.join(names)}"
        raise ApcError(
            Diagnostic("E941", SourceLocation(system.origin.topology), what, hint=f"--over {names[0]}")
        )
    return SweepChoice(names[0]) if names else SweepChoice("", _nothing(system, axis))


def _nothing(system: Model, axis: str) -> str:
    """Say why nothing of a scene is varied."""
    if axis == STIFFNESS:
        return "no stiffness is that of a coupler which hears others (--over NAME takes another)"
    if not system.links:
        return "there is no link"
    if axis == DELAY:
        return "nobody hears others over a link"
    names = " and ".join(link.name for link in system.links)
    return f"no packet can get lost; loss: 0 % written to {names} lets its loss be varied"
