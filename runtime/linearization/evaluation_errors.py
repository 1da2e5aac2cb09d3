"""Equations without a finite value, reported as user errors.

Takes: a block of code that evaluates a model's equations. Gives: `finite_equations`, `evaluating`, `at_part`,
`part_of`.
Guarantees: a division by zero, a logarithm of a negative number or a loop that Newton's method does not solve
becomes one `ApcError`; an error without a source file is located in this topology; every other exception
passes.
Does not: find the faulty equation; a named value is located at its part.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.source.nodes import Mapping
from apc.compiler.source.source import parse_source
from apc.support.threads import single_threaded

SOMEWHERE = SourceLocation("the topology")  # of an error in parameters alone

_PART = re.compile(r"(?:der\()?(\w+)(?:[.\[)]|\Z)")  # of a variable, or of its derivative

# Exceptions of Python's math module and CasADi's Newton solver at a point without a value.
_NO_VALUE = ("math domain error", "rootfinder", "Evaluation failed", "Newton", "cannot convert NaN")


@contextmanager
def finite_equations(model: Model) -> Iterator[None]:
    """Convert exceptions of equations without a finite value into an ApcError.

    Parameters
    ----------
    model
        The model whose equations are evaluated.

    Raises
    ------
    ApcError
        E808 the equations have no finite value, or no solution, at the start values.
    """
    topology = model.origin.topology
    try:
        yield
    except ApcError as error:
        raise ApcError(
            replace(mistake, location=SourceLocation(topology)) if mistake.location == SOMEWHERE else mistake
            for mistake in error.mistakes
        ) from error
    except (ZeroDivisionError, OverflowError) as error:
        raise _mistake(topology) from error
    except (ValueError, RuntimeError) as error:
        if any(words in str(error) for words in _NO_VALUE):
            raise _mistake(topology) from error
        raise


@contextmanager
def evaluating(model: Model) -> Iterator[None]:
    """Evaluate a model with one thread, without floating-point warnings, and with the errors of
    `finite_equations`.
    """
    with single_threaded(), finite_equations(model), np.errstate(all="ignore"):
        yield


def part_of(variable: str) -> str:
    """Return the name of the part of a variable, or of the derivative of a variable; "" without a part."""
    part = _PART.match(variable)
    return part[1] if part else ""


def at_part(mistake: Diagnostic, topology: str, texts: Iterable[tuple[str, bytes]]) -> Diagnostic:
    """Return a diagnostic for a value that is not finite, located at its part in the topology.

    Parameters
    ----------
    mistake
        The diagnostic; a diagnostic with another code is returned unchanged.
    topology, texts
        The file of the topology, and the texts of a model by their files.
    """
    text = dict(texts).get(topology)
    if mistake.code != "E808" or not mistake.subject or text is None:
        return mistake
    root = parse_source(text, file=topology).root
    for section in ("masses", "couplers", "hands", "links"):
        node = root.get(section) if isinstance(root, Mapping) else None
        for key, _ in node.entries if isinstance(node, Mapping) else ():
            if key.text == mistake.subject:
                return replace(mistake, location=key.location)
    return replace(mistake, location=SourceLocation(topology))


def _mistake(topology: str) -> ApcError:
    """Return error E808 for equations without a finite value at the start values."""
    message = (
        "an equation has no finite value, or a loop no solution, at the initial state: "
        "a division by zero, or a root or logarithm of a negative number"
    )
    advice = "choose an initial state at which every equation has a value"
    return ApcError(Diagnostic("E808", SourceLocation(topology), message, advice=advice))
