"""Equations without a finite value, told as the user's mistake they are.

Takes: a block of code that evaluates a scene's equations. Gives: `finite_equations`.
Guarantees: a division by zero, a logarithm of a negative number or a loop that Newton's method does not solve
becomes one `ApcError`; a mistake of numbers that know no scene is placed in this one; every other exception
passes.
Does not: find out which equation it was.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from apc.compiler.errors import ApcError, Mistake, Place

SOMEWHERE = Place("the scene")  # of a mistake in numbers by themselves

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
            replace(one, place=Place(scene)) if one.place == SOMEWHERE else one for one in error.mistakes
        ) from error
    except (ZeroDivisionError, OverflowError) as error:
        raise _mistake(scene) from error
    except (ValueError, RuntimeError) as error:
        if any(words in str(error) for words in _NO_VALUE):
            raise _mistake(scene) from error
        raise


def _mistake(scene: str) -> ApcError:
    what = (
        "an equation has no finite value, or a loop no solution, at the start values: "
        "a division by zero, a root or logarithm of a number below zero, or the like"
    )
    hint = "start values at which every equation can be evaluated"
    return ApcError(Mistake("E808", Place(scene), what, hint=hint))
