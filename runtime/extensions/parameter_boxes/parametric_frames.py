"""A model over a box, with matrices that are functions of the parameters.

Takes: a `NumericModel` and ranges as text.
Gives: `parametric_models`; `ParametricSubsystems`, `parametric_subsystems`.
Guarantees: a subsystem's matrices are exact quotients of polynomials in the parameters of the box, with
dependents by expressions included.
Does not: prove anything (see `robust_stability`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from apc.analysis.analysis import lifted_classes
from apc.compiler.compiled import Formula, Group, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.expression_data import RULES
from apc.compiler.language.evaluation import EvaluationError, exactly
from apc.extensions.parameter_boxes.rational_functions import NotRational, Ratio, Ratios, parametric_subsystem
from apc.lifting.numeric_model import NumericModel
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.network.nominal_criterion import refuse_channel_number
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import Range, overlap, proposed_range
from apc.parameter_values.parameters import scope_of
from apc.spectrum.interconnection import ClosedLoop
from apc.spectrum.modes import split
from apc.spectrum.peer_classes import PeerClass
from apc.studies.representative_delays import LOCATION
from apc.timing.communication_graph import CommunicationGraph

# The relative position in a range of the point at which peers are sorted into classes. No two given values
# are there by chance, so that peers with equal values at the point are equal over the complete box. The k-th
# range uses the k-th power, as two groups may have the same ranges.
GENERIC = Fraction(6180339887, 10**10)


def parametric_models(
    numeric: NumericModel, ranges: Sequence[Range]
) -> list[tuple[ClosedLoop, tuple[LinearSubsystem, ...]]]:
    """Return the closed systems of a model at a generic point of a box, with their parametric subsystems.

    The matrices of the subsystems are over `Fraction` and `Ratio`, in the order of `ranges`.

    Parameters
    ----------
    numeric, ranges
        The model with its parameter values, and the ranges.

    Raises
    ------
    ApcError
        E896 a parameter of an unreliable link; the errors of `parametric_subsystems`.
    """
    if not ranges:
        raise ApcError(
            Diagnostic("E830", LOCATION, "the box has no parameter", fix=proposed_range(numeric.model))
        )
    for interval in ranges:
        refuse_channel_number(numeric.model, interval.free, LOCATION)
    subsystems = parametric_subsystems(numeric, ranges, lambda changed: lifted_classes(numeric.at(changed)))
    subsystem_of_class = {
        peer_class.index: subsystems.subsystems[peer_class.name] for peer_class in subsystems.peer_classes
    }
    return [
        (
            closed_system,
            tuple(subsystem_of_class[peer_class.index] for peer_class in closed_system.peer_classes),
        )
        for closed_system in split(subsystems.peer_classes, subsystems.comm_graph)
    ]


@dataclass(frozen=True, slots=True)
class ParametricSubsystems:
    """The classes of peers that are equal over a complete box.

    `at` is the model at a point of the box, `subsystems` the matrices of each class by its name, over
    `Fraction` and `Ratio`.
    """

    at: Model
    peer_classes: tuple[PeerClass, ...]
    comm_graph: CommunicationGraph
    subsystems: Mapping[str, LinearSubsystem]


def parametric_subsystems(
    numeric: NumericModel,
    ranges: Sequence[Range],
    lifted: Callable[[Model], tuple[tuple[PeerClass, ...], CommunicationGraph]],
) -> ParametricSubsystems:
    """Return the classes of a model's peers with symbolic parameters.

    Parameters
    ----------
    numeric, ranges
        The model with its parameter values, and the ranges.
    lifted
        A function from a model to its peers in classes, lifted, and their communication graph.

    Raises
    ------
    ApcError
        E831 a parameter given twice, E832 a model that is no rational function of the parameters.
    """
    model = numeric.model
    for index, interval in enumerate(ranges):
        if any(overlap(model, earlier.free, interval.free) for earlier in ranges[:index]):
            raise ApcError(Diagnostic("E831", LOCATION, f"{interval.free.label} has two ranges in one box"))
    if not all(subsystem.parameters_suffice for subsystem in numeric.jacobians):
        message = f"{model.name} is nonlinear; the point of linearization may depend on the parameters"
        raise ApcError(Diagnostic("E832", SourceLocation(model.origin.topology), message))
    field = Ratios.of(len(ranges))
    symbolic_parameters = [_dependent_parameters(model, group, ranges, field) for group in model.groups]
    point = [
        Override(interval.free, interval.low + GENERIC**index * (interval.high - interval.low))
        for index, interval in enumerate(ranges, 1)
    ]
    at = apply(model, point)
    peer_classes, comm_graph = lifted(at)
    subsystems = {
        peer_class.name: _parametric_subsystem(
            peer_class, symbolic_parameters[comm_graph.group_of(peer_class.peers.first)], model
        )
        for peer_class in peer_classes
    }
    return ParametricSubsystems(at, peer_classes, comm_graph, subsystems)


def _dependent_parameters(
    model: Model, group: Group, ranges: Sequence[Range], field: Ratios
) -> dict[str, Ratio]:
    """Return a group's parameters that depend on those of the box, by name, as quotients of polynomials."""
    columns = {column.name for column in group.columns}
    scope = scope_of(model, group.values, fixed=columns)
    varying = scope.follow(dict.fromkeys(columns, True), lambda *_: True, lambda _: False)
    given = {
        interval.free.name: field.parameter(index)
        for index, interval in enumerate(ranges)
        if interval.free.group in (None, group.name)
    }

    def compute(name: str, formula: Formula, values: list[Any]) -> Any:
        """Return the value of a formula in exact arithmetic.

        An error E832 if it is not rational in the box.
        """
        local = [source for source in formula.names if source in varying]
        if local:
            message = f"{name} depends on {local[0]}, which differs from peer to peer of {group.name}"
            raise ApcError(Diagnostic("E832", LOCATION, message))
        try:
            return exactly(formula, values, _rational_operation)
        except EvaluationError as fault:
            reason = fault.cause if isinstance(fault.cause, NotRational) else fault.words
            message = f"{name} = {formula.text[:60]} {reason}"
            raise ApcError(Diagnostic("E832", LOCATION, message)) from None

    names_of_type = model.peer_types[group.peer_type].parameters
    result = scope.follow(given, compute, lambda name: Fraction(scope.holder[name].value), names_of_type)
    return {name: result[name] for name in names_of_type if isinstance(result.get(name), Ratio)}


def _power(base: Any, exponent: Any) -> Any:
    """Return a power with an integer exponent; NotRational for another exponent."""
    whole = int(exponent)
    if whole != exponent:
        raise NotRational("has an exponent that is not an integer")
    return base**whole


def _rational_operation(operation: str) -> Callable[..., Any]:
    """Return the operation of this name on rationals and on quotients of polynomials in the parameters.

    For an operation that is not rational, such as a sine, the result is a function that raises NotRational.
    """

    def refuse(*_: Any) -> Any:
        """Raise NotRational for an operation that is not rational."""
        raise NotRational(f"has {operation}() of a parameter in the box")

    return _RULES.get(operation, refuse)


_RULES: dict[str, Callable[..., Any]] = {
    **{word: rule for word, rule in RULES.items() if word not in ("sign", "floor")},
    "pow": _power,
}


def _parametric_subsystem(
    peer_class: PeerClass, symbolic: Mapping[str, Ratio], model: Model
) -> LinearSubsystem:
    """Return the matrices of a class of peers with the parameters of the box as symbols."""
    peer_type = peer_class.jacobians.peer_type
    numbers = zip(peer_type.parameters, peer_class.exact_parameters, strict=True)
    vector = [symbolic.get(name, value) for name, value in numbers]
    try:
        return parametric_subsystem(peer_class.jacobians, vector)
    except NotRational as reason:
        message = f"an equation of {peer_class.name} {reason}"
        raise ApcError(Diagnostic("E832", SourceLocation(model.origin.topology), message)) from None
