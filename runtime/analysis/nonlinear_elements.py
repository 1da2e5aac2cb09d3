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
from apc.frame.branch_conditions import functions_of
from apc.frame.jacobians import nodes_of
from apc.frame.numeric_model import Prepared

# Operations whose slope is zero wherever they have one.
FLAT = {casadi.OP_FLOOR, casadi.OP_CEIL, casadi.OP_SIGN}

OF_ALL = "apc simulate covers smaller motions"


def replaced_elements(system: Model) -> tuple[str, ...]:
    """Return a line for each element that is replaced, or flat, in a linear analysis.

    Parameters
    ----------
    system
        The compiled model.
    """
    peer_types = [
        system.peer_types[number] for number in dict.fromkeys(group.peer_type for group in system.groups)
    ]
    lines = [
        line
        for peer_type in peer_types
        for line in (*_replaced(peer_type), *_flat(peer_type.linear or peer_type))
    ]
    return tuple(dict.fromkeys(lines))


def is_linear(system: Model, prepared: Prepared) -> bool:
    """Return whether the equations are linear as written, with no element replaced.

    Parameters
    ----------
    system, prepared
        The compiled model, and the result of `numeric_model.prepare`.
    """
    return all(
        prepared.jacobians[group.peer_type].affine and not system.peer_types[group.peer_type].replaced
        for group in system.groups
    )


def _replaced(peer_type: PeerType) -> Iterator[str]:
    for element in peer_type.replaced:
        valid = f", valid for {element.valid}" if element.valid else ""
        yield f"{element.part} is replaced by {'; '.join(element.equations)}{valid}: {OF_ALL}"


@functools.lru_cache(maxsize=64)
def _flat(peer_type: PeerType) -> tuple[str, ...]:
    """Return a line for each equation with a floor, ceil or sign of a motion: its slope is zero."""
    result: dict[str, None] = {}
    for _, function, arguments, rows in functions_of(peer_type):
        if not function.is_a("SXFunction"):
            continue
        symbols = function.sx_in()
        column = function(*symbols)
        moving = casadi.vertcat(
            *(symbol for name, symbol in zip(arguments, symbols, strict=True) if name not in ("p", "t"))
        )
        for row in range(column.numel()):
            if any(
                node.op() in FLAT and casadi.depends_on(node.dep(0), moving) for node in nodes_of(column[row])
            ):
                name = rows[row % len(rows)]
                result[f"{name} is constant between jumps: its slope is zero in a linear analysis"] = None
    return tuple(result)
