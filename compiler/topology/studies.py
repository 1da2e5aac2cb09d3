"""The studies of a topology: the experiment, and ranges of parameters.

Takes: the sections `experiment` and `studies`. Gives: `read_experiment`, an `Experiment`; `read_studies`,
`Axis`es and the settings of tuning.
Guarantees: a duration is more than nothing, a range has its lower end first and the parameter's unit.
Does not: do it.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

from apc.compiler.compiled import Axis, Experiment
from apc.compiler.components.component import NumberParameter
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.source.nodes import Mapping, Node, Scalar, Sequence
from apc.compiler.source.reading import (
    MappingReader,
    brief,
    fault,
    form,
    mapping_of,
    text_of,
    unknown,
    whole_number,
)
from apc.compiler.topology.instances import SettableNames
from apc.compiler.topology.topology_parameters import NamedNumbers

EXPERIMENT = ("duration", "seed")
AXES = ("x", "y")
TUNED = ("free", "maximize", "minimize", "subject", "over", "hands")


def read_experiment(root: MappingReader, numbers: NamedNumbers) -> Experiment:
    """Read `experiment: {duration: 3 s, seed: 1}`; `numbers` reads the duration, in seconds."""

    def duration(node: Node, subject: str) -> Fraction:
        value = numbers.read_time(node, subject, "s")
        if value.number <= 0:
            raise fault("E207", value.location, subject, "more than 0 s", str(value))
        return value.number

    def seed(node: Node, subject: str) -> int:
        number = whole_number(node)
        if number is None or not 0 <= number < 2**63:
            raise fault("E203", node.location, subject, "a whole number, 0 or more", form(node))
        return number

    section = _section(root, "experiment", EXPERIMENT, "{duration: 3 s}")
    return Experiment(section.read("duration", duration, None), section.read("seed", seed, 0))


def _section(around: MappingReader, key: str, keys: tuple[str, ...], hint: str) -> MappingReader:
    """Return the contents of a section, which may be missing."""
    node = around.read(key, lambda node, _: mapping_of(node, key, f"{key}: {hint}"), None)
    return MappingReader(node or Mapping((), around.location), keys, key, around.mistakes)


def read_studies(
    root: MappingReader, settable: SettableNames, numbers: NamedNumbers, is_reported: Callable[[str], bool]
) -> tuple[tuple[Axis, ...], tuple[tuple[str, str], ...]]:
    """Read `studies: {region: {x: {contact.stiffness: [0 N/m, 5000 N/m]}, y: …}, tune: {free: …}}`.

    Parameters
    ----------
    root
        The topology.
    settable
        The settable names, as written.
    numbers
        Reads a value of a parameter.
    is_reported
        Whether a name's part was reported as faulty, so that its absence needs no message.

    Returns
    -------
    tuple of Axis
        The axes of the region.
    tuple of (str, str)
        The tuning study, as in `compiled.Model.tune`.
    """

    def values(key: str, name: Scalar, span: Node, hint: str) -> tuple[ScalarValue, ScalarValue]:
        if not (isinstance(span, Sequence) and len(span.items) == 2):
            raise fault("E203", span.location, name.text, "a list of two values", form(span), hint)
        known = {known: item for known, (item, _) in settable.items() if isinstance(item, NumberParameter)}
        if name.text not in known:
            if is_reported(name.text):
                raise AlreadyReportedError
            message = f"{key} names {brief(name.text)}, which is no parameter of a part"
            raise unknown("E206", name.location, message, name.text, known)
        low, high = (numbers.read_for(item, name.text, known[name.text]) for item in span.items)
        if low.number >= high.number:
            message = f"the range of {name.text}"
            raise fault("E207", span.location, message, "its lower end first", f"{low} to {high}")
        return low, high

    def axis(node: Node, key: str) -> Axis:
        hint = f"{key}: {{contact.stiffness: [0 N/m, 5000 N/m]}}"
        body = mapping_of(node, key, hint)
        if len(body.entries) != 1:
            raise fault("E203", body.location, key, "one parameter and its range", hint=hint)
        name, span = body.entries[0]
        low, high = values(key, name, span, hint)
        return Axis(name.text, low.number, high.number)

    def free(name: Scalar, span: Node) -> tuple[str, str]:
        low, high = values("free", name, span, f"free: {{{name.text}: [10 N/m, 5000 N/m]}}")
        unit = format_dimension(low.dimension)
        return "free", f"{name.text}={float(low.number)!r} {unit}:{float(high.number)!r} {unit}"

    def listed(key: str) -> Callable[[Scalar, Node], tuple[str, str]]:
        return lambda name, node: (key, f"{name.text}={text_of(node, name.text)}")

    studies = _section(root, "studies", ("region", "tune"), "{region: {x: …, y: …}}")
    region = _section(studies, "region", AXES, "{x: …, y: …}")
    axes = (region.read(key, axis, None) for key in AXES)
    tune = _section(studies, "tune", TUNED, "{free: …, maximize: …}")
    requested = tune.each("free", "{coordination.stiffness: [10 N/m, 5000 N/m]}", free)
    for key, hint in (("subject", "{decay: 60 dB in 2 s}"), ("over", "{user.count: 2:10}")):
        requested += tune.each(key, hint, listed(key))
    requested += [(key, tune.text(key)) for key in ("maximize", "minimize", "hands") if key in tune.nodes]
    return tuple(axis for axis in axes if axis is not None), tuple(requested)
