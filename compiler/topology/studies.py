"""The studies of a topology: the experiment, and ranges of parameters.

Takes: the sections `experiment` and `studies`. Gives: `read_experiment`, an `Experiment`; `read_studies`,
`Axis`es and the settings of tuning.
Guarantees: a duration is positive, a range has its lower end first and the parameter's unit.
Does not: run a study.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

from apc.compiler.compiled import Axis, Experiment, Formula, PeerTime
from apc.compiler.components.component import NumberParameter
from apc.compiler.language.evaluation import formula_of
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.source.nodes import Mapping, Node, Scalar, Sequence
from apc.compiler.source.reading import (
    MappingReader,
    fault,
    form,
    mapping_of,
    named,
    text_of,
    unknown,
    whole_number,
)
from apc.compiler.topology.instances import SettableNames
from apc.compiler.topology.topology_parameters import NamedNumbers

EXPERIMENT = ("duration", "seed", "joins", "leaves")
AXES = ("x", "y")
TUNED = ("free", "maximize", "minimize", "subject", "over", "hands")


def read_experiment(root: MappingReader, numbers: NamedNumbers) -> Experiment:
    """Return the experiment, from the section `experiment: {duration: 3 s, joins: {"user[3]": 1 s}}`.

    `numbers` reads the times.
    """

    def duration(node: Node, subject: str) -> tuple[Fraction, Formula | None]:
        """Return the positive duration in seconds, and its formula."""
        value = numbers.read_time(node, subject, "s")
        if value.number <= 0:
            raise fault("E207", value.location, subject, "more than 0 s", str(value))
        return value.number, formula(value)

    def seed(node: Node, subject: str) -> int:
        """Return the seed of random numbers, an integer from 0 to 2^63 - 1."""
        number = whole_number(node)
        if number is None or not 0 <= number < 2**63:
            raise fault("E203", node.location, subject, "a whole number, 0 or more", form(node))
        return number

    def peer_time(name: Scalar, node: Node) -> PeerTime:
        """Return the instant of one peer, in seconds."""
        at = numbers.read_time(node, name.text, "s")
        return PeerTime(name.text, at.number, name.location.line, name.location.column, formula(at))

    def formula(value: ScalarValue) -> Formula | None:
        """Return the formula of a time, None if it depends on no parameter."""
        return None if value.expression is None else formula_of(value.expression)

    section = _section(root, "experiment", EXPERIMENT, "{duration: 3 s}")
    lasts, follows = section.read("duration", duration, (None, None))
    joins, leaves = (tuple(section.each(key, '{"user[3]": 1 s}', peer_time)) for key in ("joins", "leaves"))
    return Experiment(lasts, section.read("seed", seed, 0), joins, leaves, follows)


def _section(parent: MappingReader, key: str, keys: tuple[str, ...], fix: str) -> MappingReader:
    """Return a reader of a subsection; a missing subsection is read as an empty mapping.

    Parameters
    ----------
    parent, key
        The section that contains it, and its key.
    keys, fix
        The keys that it may have, and an example for messages.
    """
    node = parent.read(key, lambda node, _: mapping_of(node, key, f"{key}: {fix}"), None)
    return MappingReader(node or Mapping((), parent.location), keys, key, parent.mistakes)


def read_studies(
    root: MappingReader, settable: SettableNames, numbers: NamedNumbers, is_reported: Callable[[str], bool]
) -> tuple[tuple[Axis, ...], tuple[tuple[str, str], ...]]:
    """Return the axes and the tuning study, from `studies: {region: {x: …, y: …}, tune: {free: …}}`.

    Parameters
    ----------
    root
        The topology.
    settable
        The settable names, with their declarations.
    numbers
        The named numbers that the ends of a range may depend on.
    is_reported
        Whether an error of the part of a name was reported, so that an unknown name needs no second message.

    Returns
    -------
    tuple of Axis
        The axes of the region.
    tuple of (str, str)
        The tuning study, as in `compiled.Model.tune`.
    """

    def values(key: str, name: Scalar, span: Node, fix: str) -> tuple[ScalarValue, ScalarValue]:
        """Return the lower and the upper end of the range of the parameter `name`.

        `key` and `fix` are for messages.
        """
        if not (isinstance(span, Sequence) and len(span.items) == 2):
            raise fault("E203", span.location, name.text, "[min, max]", form(span), fix)
        known = {word: item for word, (item, _) in settable.items() if isinstance(item, NumberParameter)}
        if name.text not in known:
            if is_reported(name.text):
                raise AlreadyReportedError
            message = f"{key}: unknown parameter {named(name.text)}"
            raise unknown("E206", name.location, message, name.text, known)
        low, high = (numbers.read_for(item, name.text, known[name.text]) for item in span.items)
        if low.number >= high.number:
            fix = f"{name.text}: [{high}, {low}]" if low.number > high.number else ""
            expected = "the lower end first" if fix else "two different ends"
            raise fault("E207", span.location, name.text, expected, fix=fix)
        return low, high

    def axis(node: Node, key: str) -> Axis:
        """Return the axis of the region from a mapping with one parameter and its range, in SI units."""
        fix = f"{key}: {{contact.stiffness: [0 N/m, 5000 N/m]}}"
        body = mapping_of(node, key, fix)
        if len(body.entries) != 1:
            raise fault("E203", body.location, key, "one parameter and its range", fix=fix)
        name, span = body.entries[0]
        low, high = values(key, name, span, fix)
        return Axis(name.text, low.number, high.number)

    def free(name: Scalar, span: Node) -> tuple[str, str]:
        """Return the setting `free` of one tuned parameter, as text `NAME=LOW UNIT:HIGH UNIT`."""
        low, high = values("free", name, span, f"free: {{{name.text}: [10 N/m, 5000 N/m]}}")
        unit = format_dimension(low.dimension)
        return "free", f"{name.text}={float(low.number)!r} {unit}:{float(high.number)!r} {unit}"

    def listed(key: str) -> Callable[[Scalar, Node], tuple[str, str]]:
        """Return a function that returns a setting `key` of the tuning study as text `NAME=VALUE`."""
        return lambda name, node: (key, f"{name.text}={text_of(node, name.text)}")

    studies = _section(root, "studies", ("region", "tune"), "{region: {x: …, y: …}}")
    region = _section(studies, "region", AXES, "{x: …, y: …}")
    axes = (region.read(key, axis, None) for key in AXES)
    tune = _section(studies, "tune", TUNED, "{free: …, maximize: …}")
    settings = tune.each("free", "{coordination.stiffness: [10 N/m, 5000 N/m]}", free)
    for key, fix in (("subject", "{decay: 60 dB in 2 s}"), ("over", "{user.count: 2:10}")):
        settings += tune.each(key, fix, listed(key))
    settings += [(key, tune.text(key)) for key in ("maximize", "minimize", "hands") if key in tune.nodes]
    return tuple(axis for axis in axes if axis is not None), tuple(settings)
