"""Run-time checks of arguments of public functions against their annotations.

Takes: a function whose parameters are annotated.
Gives: `checked`.
Guarantees: a wrong type raises a TypeError with the argument's name, the expected and the actual type.
Does not: check the contents of texts, or keys and plain values of mappings: their readers raise ApcError.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from apc.compiler.compiled import Model
from apc.support.renamed import FORMER_ARGUMENTS

P = ParamSpec("P")
T = TypeVar("T")

# Types accepted for an annotated type: NumPy numbers for numbers, path-like objects for a path. A compiled
# model is accepted here instead of a path: the function itself raises the error.
WIDER: Mapping[Any, tuple[type, ...]] = {
    int: (Integral,),
    float: (Real,),
    Path: (os.PathLike, Model),
}


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function with checked arguments: an argument of a wrong type raises a TypeError.

    Parameters
    ----------
    function
        The function, whose annotations are resolved in its module; for a `Literal` any text is accepted.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        """Check the arguments, then call the function."""
        hints = _hints(function)
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            former = FORMER_ARGUMENTS[""] | FORMER_ARGUMENTS.get(function.__name__, {})
            renamed = [
                f"unknown argument {name}=; its present name is {former[name]}="
                for name in kwargs
                if name in former
            ]
            message = renamed[0] if renamed else error
            raise TypeError(f"apc.{function.__name__}: {message}") from None
        for name, value in bound.arguments.items():
            if name in hints and not _fits(value, hints[name]):
                wants = re.sub(r"\w+\.", "", inspect.formatannotation(hints[name]))
                got = f"{type(value).__name__}: {value!r:.80}"
                raise TypeError(f"apc.{function.__name__}: {name}: expected {wants}, got {got}")
        return function(*args, **kwargs)

    return call


@functools.cache
def _hints(function: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the resolved types of a function's parameters, by name."""
    names = {name: fix for name, fix in function.__annotations__.items() if name != "return"}
    holder = type("Holder", (), {"__annotations__": names})
    return get_type_hints(holder, globalns=function.__globals__, localns={"Method": str})


def _fits(value: Any, fix: Any) -> bool:
    """Return whether a value has an annotated type, or an accepted type (see `WIDER`)."""
    origin, inner = get_origin(fix), get_args(fix)
    if fix is Any:
        return True
    if origin in (Union, UnionType):
        return any(_fits(value, item) for item in inner)
    if origin is Literal:
        return isinstance(value, str)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            _fits(key, inner[0]) and (_fits(item, inner[1]) or not isinstance(item, list | tuple))
            for key, item in value.items()
        )
    if origin is tuple:
        return isinstance(value, tuple | list) and len(value) == len(inner) and all(map(_fits, value, inner))
    if origin in (Sequence, Iterable):
        is_iterable = isinstance(value, Iterable) and not isinstance(value, Mapping | bytes | str)
        return is_iterable and (origin is Iterable or all(_fits(item, inner[0]) for item in value))
    return isinstance(value, WIDER.get(fix, fix if fix is not None else type(None)))
