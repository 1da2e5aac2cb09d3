"""Equations without a finite value, told as the user's mistake they are.

Takes: a block of code that evaluates a scene's equations. Gives: `finite_equations`, `at_its_part`,
`part_of`.
Guarantees: a division by zero, a logarithm of a negative number or a loop that Newton's method does not solve
becomes one `ApcError`; a mistake of numbers that know no scene is placed in this one; every other exception
passes.
Does not: find out which equation it was; a value that has a name leads to its part.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.source.nodes import Mapping
from apc.compiler.source.source import parse_source

SOMEWHERE = SourceLocation("the scene")  # of a mistake in numbers by themselves

_PART = re.compile(r"(?:der\()?(\w+)(?:[.\[)]|\Z)")  # of a variable, or of its derivative

# What Python's math module and CasADi's Newton solver say of a point where a function has no value.
_NO_VALUE = ("math domain error", "rootfinder", "Evaluation failed", "Newton", "cannot convert NaN")


@contextmanager
def finite_equations(scene: str) -> Iterator[None]:
    """Turn what an equation without a finite value raises into a mistake.

    Parameters
    ----------
    scene
        The file that the scene stands in.

    Raises
    ------
    ApcError
        E808 the equations have no finite value, or no solution, at the start values.
    """
    try:
        yield
    except ApcError as error:
        raise ApcError(
            replace(mistake, place=SourceLocation(scene)) if mistake.place == SOMEWHERE else mistake
            for mistake in error.mistakes
        ) from error
    except (ZeroDivisionError, OverflowError) as error:
        raise _mistake(scene) from error
    except (ValueError, RuntimeError) as error:
        if any(words in str(error) for words in _NO_VALUE):
            raise _mistake(scene) from error
        raise


def part_of(variable: str) -> str:
    """Return the name of the part that a variable, or the derivative of one, belongs to; "" of none."""
    part = _PART.match(variable)
    return part[1] if part else ""


def at_its_part(mistake: Diagnostic, topology: str, texts: Iterable[tuple[str, bytes]]) -> Diagnostic:
    """Return a mistake of a value that is not finite where the topology names the part of it.

    Parameters
    ----------
    mistake
        The mistake; of another code it stays as it is.
    topology, texts
        The file of the topology, and the texts of a scene by their files.
    """
    text = dict(texts).get(topology)
    if mistake.code != "E808" or not mistake.subject or text is None:
        return mistake
    root = parse_source(text, file=topology).root
    for section in ("masses", "couplers", "hands", "links"):
        node = root.get(section) if isinstance(root, Mapping) else None
        for key, _ in node.entries if isinstance(node, Mapping) else ():
            if key.text == mistake.subject:
                return replace(mistake, place=key.place)
    return replace(mistake, place=SourceLocation(topology))


def _mistake(scene: str) -> ApcError:
    what = (
        "an equation has no finite value, or a loop no solution, at the start values: "
        "a division by zero, a root or logarithm of a number below zero, or the like"
    )
    hint = "start values at which every equation can be evaluated"
    return ApcError(Diagnostic("E808", SourceLocation(scene), what, hint=hint))
