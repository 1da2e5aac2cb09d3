"""Data types that are cheap to make: what `dataclasses.dataclass` gives, with nothing written beforehand.

Takes: a class with annotations. Gives: `dataclass`.
Guarantees: `match`, and the standard library's `field`, `replace`, `fields` and `astuple`, take such a class
as any other.
Does not: call `__post_init__`, or make a class without slots.

The standard decorator writes six methods as text and compiles them for every class that a run imports, which
took longer than to compile a small scene. Here they are the same few functions for all, until so many objects
of a class are made that methods written for it pay: then it gets the standard ones.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, FrozenInstanceError
from operator import attrgetter
from typing import Any, TypeVar, dataclass_transform

T = TypeVar("T")
_ORDERS = ("__lt__", "__le__", "__gt__", "__ge__")
# Written methods save half a microsecond an object, and cost 700 a class.
OFTEN = 1500


@dataclass_transform(field_specifiers=(dataclasses.field,))
def dataclass(
    *, slots: bool, frozen: bool = False, eq: bool = True, order: bool = False, kw_only: bool = False
) -> Callable[[type[T]], type[T]]:
    """Return a decorator that makes a slotted class of the fields that a class annotates.

    Parameters
    ----------
    slots
        True, as the class has no other place for its fields.
    frozen, eq, order, kw_only
        As in the standard library.
    """
    assert slots

    def made(cls: type[T]) -> type[T]:
        space = {name: one for name, one in vars(cls).items() if name not in ("__dict__", "__weakref__")}
        known: dict[str, Field[Any]] = {}
        for base in reversed(cls.__mro__[1:]):
            known |= vars(base).get("__dataclass_fields__", {})
        slotted = set(known)
        for name, annotation in space.get("__annotations__", {}).items():
            if "ClassVar" not in str(annotation):
                known[name] = _field(name, annotation, space.pop(name, MISSING), kw_only=kw_only)
        space["__slots__"] = tuple(name for name in known if name not in slotted)
        space["__dataclass_fields__"] = known
        space.setdefault("__match_args__", tuple(one.name for one in known.values() if not one.kw_only))
        methods = {"__repr__": _repr, "__getstate__": _getstate, "__setstate__": _setstate}
        if eq:
            compared = tuple(one.name for one in known.values() if one.compare)
            methods |= _comparing(compared, frozen=frozen, order=order)
        if frozen:
            methods |= {"__setattr__": _setattr, "__delattr__": _delattr}
        for name, method in methods.items():
            space.setdefault(name, method)
        result: Any = type(cls)(cls.__name__, cls.__bases__, space)  # type: ignore[misc] # a class as `cls` is

        def write() -> None:
            """Take the standard methods in the place of ours."""
            listed = [(one.name, one.type, one) for one in known.values()]
            standard = dataclasses.make_dataclass(
                cls.__name__, listed, repr=False, eq=eq, order=order, frozen=frozen
            )
            for name in ("__init__", "__eq__", "__hash__", *_ORDERS):
                if getattr(vars(result).get(name), "__module__", "") == __name__:
                    setattr(result, name, vars(standard)[name])

        if "__init__" not in space:
            result.__init__ = _initializer(result, known.values(), write)
        return result  # type: ignore[no-any-return]

    return made


def _field(name: str, annotation: Any, default: Any, *, kw_only: bool) -> Field[Any]:
    found: Field[Any] = default if isinstance(default, Field) else dataclasses.field(default=default)
    found.name, found.type = name, annotation
    found._field_type = dataclasses._FIELD  # type: ignore[attr-defined] # by which `fields` knows it
    if found.kw_only is MISSING:
        found.kw_only = kw_only
    return found


def _initializer(cls: type, fields: Iterable[Field[Any]], write: Callable[[], None]) -> Callable[..., None]:
    """Return what sets the fields of a new object; once there are many of them, it calls `write`."""
    ordered = sorted(fields, key=attrgetter("kw_only"))  # what is given by place comes first
    setters = [getattr(cls, one.name).__set__ for one in ordered]
    count = len(ordered)

    objects = itertools.count(1)

    def __init__(self: Any, /, *values: Any, **named: Any) -> None:
        if next(objects) == OFTEN:
            write()
        for put, value in zip(
            setters,
            values if len(values) == count and not named else _completed(cls, ordered, values, named),
            strict=True,
        ):
            put(self, value)

    __init__.__qualname__ = f"{cls.__qualname__}.__init__"
    return __init__


def _completed(
    cls: type, ordered: Sequence[Field[Any]], values: Sequence[Any], named: dict[str, Any]
) -> list[Any]:
    """Return a value for each field. Raises TypeError as a call of a function of these arguments does."""
    if len(values) > sum(not one.kw_only for one in ordered):
        raise TypeError(f"{cls.__qualname__}() takes fewer than {len(values)} values by place")
    found = list(values)
    for one in ordered[len(values) :]:
        if one.name in named:
            found.append(named.pop(one.name))
        elif one.default is not MISSING:
            found.append(one.default)
        elif one.default_factory is not MISSING:
            found.append(one.default_factory())
        else:
            raise TypeError(f"{cls.__qualname__}() wants a value for {one.name!r}")
    if named:
        raise TypeError(f"{cls.__qualname__}() takes no, or already has, {', '.join(named)}")
    return found


def _comparing(names: Sequence[str], *, frozen: bool, order: bool) -> dict[str, Any]:
    """Return the methods that compare two objects of one class by these fields."""
    if len(names) > 1:
        key: Callable[[Any], tuple[Any, ...]] = attrgetter(*names)
    else:

        def key(self: Any) -> tuple[Any, ...]:
            return tuple(getattr(self, name) for name in names)

    def __eq__(self: Any, other: object) -> bool:
        return key(self) == key(other) if type(self) is type(other) else NotImplemented

    def __hash__(self: Any) -> int:
        return hash(key(self))

    methods: dict[str, Any] = {"__eq__": __eq__, "__hash__": __hash__ if frozen else None}
    return methods | ({name: _ordering(name, key) for name in _ORDERS} if order else {})


def _ordering(name: str, key: Callable[[Any], tuple[Any, ...]]) -> Callable[[Any, Any], bool]:
    compared = getattr(tuple, name)

    def compare(self: Any, other: Any) -> bool:
        return compared(key(self), key(other)) if type(self) is type(other) else NotImplemented

    return compare


def _repr(self: Any) -> str:
    shown = (f"{one.name}={getattr(self, one.name)!r}" for one in _fields(self).values() if one.repr)
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _fields(self: Any) -> Mapping[str, Field[Any]]:
    found: Mapping[str, Field[Any]] = self.__dataclass_fields__
    return found


def _setattr(self: Any, name: str, value: Any) -> None:
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def _delattr(self: Any, name: str) -> None:
    raise FrozenInstanceError(f"cannot delete field {name!r}")


def _getstate(self: Any) -> list[Any]:
    return [getattr(self, name) for name in _fields(self)]


def _setstate(self: Any, state: list[Any]) -> None:
    for name, value in zip(_fields(self), state, strict=True):
        object.__setattr__(self, name, value)
