"""What a topology asks to be done with its scene: the experiment, and ranges of parameters to study.

Takes: the sections `experiment` and `studies`. Gives: an `Experiment`, `Axis`es.
Guarantees: a duration is more than nothing, a range has its lower end first and the parameter's unit.
Does not: do it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from apc.compiler.compiled import Axis, Experiment
from apc.compiler.components.component import Number, Settable
from apc.compiler.errors import Mistakes
from apc.compiler.language.values import Value
from apc.compiler.source.nodes import Node, Sequence
from apc.compiler.source.reading import add_unknown, brief, check_keys, form, read_mapping, whole_number

# What can be set: by the name a person writes, the whole names it stands for.
SettableNames = Mapping[str, list[tuple[str, Settable]]]


def read_experiment(
    node: Node | None, read_time: Callable[[Node | None, str, str], Value | None], mistakes: Mistakes
) -> Experiment:
    """Read `experiment: {duration: 3 s, seed: 1}`.

    Parameters
    ----------
    node
        The section.
    read_time
        Reads a duration in seconds; its other arguments say what it is, and in what unit, for messages.
    mistakes
        Takes E203 and E207.
    """
    section = read_mapping(node, "experiment", mistakes, hint="experiment: {duration: 3 s}")
    if section is None:
        return Experiment()
    section = check_keys(section, ("duration", "seed"), "experiment", mistakes)
    duration = read_time(section.get("duration"), "duration", "s")
    if duration is not None and duration.number <= 0:
        got = str(duration)
        mistakes.add("E207", duration.place, "duration", expected="more than 0 s", got=got)
    seed = section.get("seed")
    number = 0 if seed is None else whole_number(seed)
    if seed is not None and (number is None or not 0 <= number < 2**63):
        mistakes.add("E203", seed.place, "seed", expected="a whole number, 0 or more", got=form(seed))
    return Experiment(duration.number if duration is not None else None, number or 0)


def read_region(
    node: Node | None,
    settable: SettableNames,
    is_reported: Callable[[str], bool],
    read_number: Callable[[Node, str, Settable], Value | None],
    mistakes: Mistakes,
) -> tuple[Axis, ...]:
    """Read `studies: {region: {x: {contact.stiffness: [0 N/m, 5000 N/m]}, y: …}}`.

    Parameters
    ----------
    node
        The section `studies`.
    settable
        What can be set, by the name a person writes.
    is_reported
        Whether a name's part was reported as faulty, so that its absence needs no message.
    read_number
        Reads a value of a parameter.
    mistakes
        Where faults go.
    """
    section = read_mapping(node, "studies", mistakes, hint="studies: {region: {x: …, y: …}}")
    if section is None:
        return ()
    section = check_keys(section, ("region",), "studies", mistakes)
    region = read_mapping(section.get("region"), "region", mistakes, hint="region: {x: …, y: …}")
    if region is None:
        return ()
    region = check_keys(region, ("x", "y"), "region", mistakes)
    axes = (_axis(key, region.get(key), settable, is_reported, read_number, mistakes) for key in ("x", "y"))
    return tuple(axis for axis in axes if axis is not None)


def _axis(
    key: str,
    node: Node | None,
    settable: SettableNames,
    is_reported: Callable[[str], bool],
    read_number: Callable[[Node, str, Settable], Value | None],
    mistakes: Mistakes,
) -> Axis | None:
    hint = f"{key}: {{contact.stiffness: [0 N/m, 5000 N/m]}}"
    body = read_mapping(node, key, mistakes, hint=hint)
    if body is None:
        return None
    if len(body.entries) != 1:
        mistakes.add("E203", body.place, key, expected="one parameter and its range", hint=hint)
        return None
    name, span = body.entries[0]
    if not (isinstance(span, Sequence) and len(span.items) == 2):
        got = form(span)
        mistakes.add("E203", span.place, name.text, expected="a list of two values", got=got, hint=hint)
        return None
    items = settable.get(name.text)
    if not items or not isinstance(items[0][1], Number):
        if not is_reported(name.text):
            what = f"{key} names {brief(name.text)}, which is no parameter of a part"
            known = [known for known, found in settable.items() if isinstance(found[0][1], Number)]
            add_unknown("E206", name.place, what, name.text, known, mistakes)
        return None
    low, high = (read_number(item, name.text, items[0][1]) for item in span.items)
    if low is None or high is None:
        return None
    if low.number >= high.number:
        what, got = f"the range of {name.text}", f"{low} to {high}"
        mistakes.add("E207", span.place, what, expected="its lower end first", got=got)
        return None
    return Axis(name.text, low.number, high.number)
