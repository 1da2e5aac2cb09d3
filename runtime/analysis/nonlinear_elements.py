"""The elements of a topology that a linear analysis replaces or cannot represent.

Takes: a `Model`.
Gives: `replaced_elements`, `is_linear`.
Guarantees: each part that other equations represent in a linear analysis is named with them, and each
equation that is constant between jumps.
Does not: find kinks (see `one_sided_slopes`).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import casadi

from apc.compiler.compiled import Model, PeerType
from apc.lifting.numeric_model import NumericModel
from apc.linearization.branch_conditions import functions_of
from apc.linearization.jacobians import nodes_of

# Operations whose slope is zero wherever they have one.
FLAT = {casadi.OP_FLOOR, casadi.OP_CEIL, casadi.OP_SIGN}

OF_ALL = "use apc simulate for smaller motions"


def replaced_elements(model: Model) -> tuple[str, ...]:
    """Return one sentence for each element that a linear analysis replaces, or whose slope is zero there.

    Parameters
    ----------
    model
        The compiled model.
    """
    peer_types = [
        model.peer_types[number] for number in dict.fromkeys(group.peer_type for group in model.groups)
    ]
    lines = [
        line
        for peer_type in peer_types
        for line in (*_replaced(peer_type), *_flat(peer_type.linear or peer_type))
    ]
    return tuple(dict.fromkeys(lines))


def is_linear(numeric: NumericModel) -> bool:
    """Return whether the equations are linear as written, with no element replaced.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    """
    return all(
        numeric.jacobians[group.peer_type].affine and not numeric.model.peer_types[group.peer_type].replaced
        for group in numeric.model.groups
    )


def _replaced(peer_type: PeerType) -> Iterator[str]:
    """Yield one sentence for each element of a peer type that other equations replace in a linear
    analysis.
    """
    for element in peer_type.replaced:
        valid = f", valid for {element.valid}" if element.valid else ""
        yield f"{element.part} is replaced by {'; '.join(element.equations)}{valid}: {OF_ALL}"


@functools.lru_cache(maxsize=64)
def _flat(peer_type: PeerType) -> tuple[str, ...]:
    """Return one sentence for each equation with a floor, ceil or sign of a state: its slope is zero."""
    result: dict[str, None] = {}
    for _, function, arguments, rows in functions_of(peer_type):
        if not function.is_a("SXFunction"):
            continue
        symbols = function.sx_in()
        outputs = function(*symbols)
        variables = casadi.vertcat(
            *(symbol for name, symbol in zip(arguments, symbols, strict=True) if name not in ("p", "t"))
        )
        for row in range(outputs.numel()):
            if any(
                node.op() in FLAT and casadi.depends_on(node.dep(0), variables)
                for node in nodes_of(outputs[row])
            ):
                name = rows[row % len(rows)]
                result[f"{name} is constant between jumps: its slope is zero in a linear analysis"] = None
    return tuple(result)
