"""What is recorded of a simulation: names such as `left[2].cube.x`, and choosing among them.

Takes: what can be recorded of a site of each group. Gives: `Signal`, `Choice`, `choose`.
Guarantees: signals stand by group, peer and site, in the scene's order, whatever the order of the patterns; a
pattern that fits nothing is refused with the nearest name.
Does not: hold values.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place, nearest
from apc.simulation.local_signals import LocalSignal

EXAMPLE = "'cube.x', 'left[2].*' or '*.v'"


@dataclass(frozen=True, slots=True)
class Signal:
    """One column of a trajectory: `local` (such as `cube.x`) of peer number `peer` (from 1) of a group."""

    group: str
    peer: int
    local: str
    unit: str
    role: str

    @property
    def name(self) -> str:
        """The whole name, as in `left[2].cube.x`."""
        return f"{self.group}[{self.peer}].{self.local}"

    @property
    def heading(self) -> str:
        """The name with its unit, as in `left[2].cube.x [m]`."""
        return f"{self.name} [{self.unit}]"


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What is recorded of a group: `locals`, of every peer; `wanted` (peers, locals) says which are kept."""

    locals: tuple[LocalSignal, ...]
    wanted: NDArray[np.bool_]


def choose(
    system: CompiledSystem, available: Sequence[Sequence[LocalSignal]], patterns: Sequence[str]
) -> tuple[Choice, ...]:
    """Choose the signals that fit some pattern, all of them if there is none.

    Parameters
    ----------
    system
        The compiled scene.
    available
        What can be recorded of a peer of each group.
    patterns
        Names with `*` for any text and `?` for any character; without a group they mean every peer's.

    Raises
    ------
    ApcError
        E873 a pattern fits no signal.
    """
    tests = [(pattern, _test(pattern)) for pattern in patterns]
    used: set[str] = set()
    choices = []
    for group, found in zip(system.groups, available, strict=True):
        wanted = np.full((group.count, len(found)), not patterns)
        for pattern, test in tests:
            for place, local in enumerate(found):
                if test.fullmatch(local.name):
                    wanted[:, place] = True
                    used.add(pattern)
                elif "[" in pattern or pattern.startswith(("*", group.name)):
                    names = (f"{group.name}[{i + 1}].{local.name}" for i in range(group.count))
                    fits = np.fromiter((bool(test.fullmatch(name)) for name in names), bool, group.count)
                    wanted[:, place] |= fits
                    used |= {pattern} if fits.any() else set()
        kept: NDArray[np.bool_] = np.any(wanted, axis=0)
        choices.append(
            Choice(
                tuple(local for local, keep in zip(found, kept.tolist(), strict=True) if keep),
                np.ascontiguousarray(wanted[:, kept]),
            )
        )
    for pattern in patterns:
        if pattern not in used:
            _refuse(system, available, pattern)
    return tuple(choices)


def signals_of(system: CompiledSystem, choices: Sequence[Choice]) -> tuple[Signal, ...]:
    """Return the chosen signals, in order."""
    return tuple(
        Signal(group.name, peer + 1, local.name, local.unit, local.role)
        for group, choice in zip(system.groups, choices, strict=True)
        for peer in range(group.count)
        for place, local in enumerate(choice.locals)
        if choice.wanted[peer, place]
    )


def _test(pattern: str) -> re.Pattern[str]:
    """Return what matches a pattern; brackets are part of names."""
    return re.compile(re.escape(pattern.strip()).replace(r"\*", ".*").replace(r"\?", "."))


def _refuse(system: CompiledSystem, available: Sequence[Sequence[LocalSignal]], pattern: str) -> None:
    names = dict.fromkeys(local.name for found in available for local in found)
    names |= dict.fromkeys(
        f"{group.name}[1].{local.name}"
        for group, found in zip(system.groups, available, strict=True)
        for local in found
    )
    what = f"no signal fits {pattern[:80]!r}; the signals of a peer are {', '.join(list(names)[:12])}"
    hint = f"--signals {nearest(pattern, names)}" if nearest(pattern, names) else f"names such as {EXAMPLE}"
    raise ApcError(Mistake("E873", Place(system.name), what, hint=hint))
