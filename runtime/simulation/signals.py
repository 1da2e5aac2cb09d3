"""The signals of a simulation: recordable signals of a subsystem, names such as `left[2].cube.x`, selection.

Takes: a `PeerType` and its `Schedule`; patterns of names.
Gives: `LocalSignal`, `local_signals`; `Signal`, `SignalSelection`, `choose`, `signals_of`; `sent_states`,
`ticking_partitions`.
Guarantees: a value that acts later than it is computed is two signals, any other is one; signals are ordered
by group, peer and subsystem as in the model, independent of the order of the patterns. A pattern without a
match is refused with the nearest name.
Does not: store values.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.timing.schedule import HoldUpdate, Propagate, Schedule, Tick

EXAMPLE = "'cube.x', 'left[2].*' or '*.v'"


@dataclass(frozen=True, slots=True)
class LocalSignal:
    """A recordable signal of a subsystem.

    `role` is "state", "output" (as newly computed), "hold" (acting) or "limited" (a limited value that is
    none of these); `index` is that of the state, of the (clock partition, output), of the hold, or of the
    limit.
    """

    name: str
    unit: str
    role: str
    index: tuple[int, ...]


def local_signals(peer_type: PeerType, schedule: Schedule) -> tuple[LocalSignal, ...]:
    """Return the recordable signals of a subsystem.

    A value that takes effect when computed is one signal; a value that takes effect later is two: `contact.f`
    as computed, and `contact.f acting`.
    """
    signals = [
        LocalSignal(state.name, state.unit, "state", (index,)) for index, state in enumerate(peer_type.states)
    ]
    ticking = ticking_partitions(schedule)
    for p in ticking:
        partition = peer_type.clocks[p]
        signals += [
            LocalSignal(name, unit, "output", (p, o))
            for o, (name, unit) in enumerate(zip(partition.outputs, partition.units, strict=True))
        ]
    partition_of = {partition.clock: p for p, partition in enumerate(peer_type.clocks)}
    delayed = _late_holds(schedule)
    for h, hold in enumerate(peer_type.holds):
        p = partition_of[hold.clock]
        if h in delayed:
            unit = peer_type.clocks[p].units[hold.output]
            signals.append(LocalSignal(f"{hold.name} acting", unit, "hold", (h,)))
    signals += [
        LocalSignal(limit.name, limit.unit, "limited", (index,))
        for index, limit in enumerate(peer_type.limits)
        if limit.value is not None
    ]
    return tuple(signals)


def sent_states(peer_type: PeerType) -> dict[int, list[tuple[str, str]]]:
    """Return the links and channels of the states that a subsystem sends to others unchanged, by index."""
    sent: dict[int, list[tuple[str, str]]] = {}
    for send in peer_type.sends:
        if send.send.is_a("SXFunction"):
            inputs = send.send.sx_in()
            channels = send.send(*inputs)
            for row, channel in enumerate(send.channels):
                for index in range(len(peer_type.states)):
                    if casadi.is_equal(channels[row], inputs[0][index]):
                        sent.setdefault(index, []).append((send.link, channel))
    return sent


def ticking_partitions(schedule: Schedule) -> list[int]:
    """Return the indices of the clock partitions that tick in a frame, in order."""
    return sorted({event.partition for event in schedule.events if isinstance(event, Tick)})


def _late_holds(schedule: Schedule) -> set[int]:
    """Return the indices of the holds that output a value later than it is computed."""
    computed: set[tuple[int, int]] = set()
    delayed = set()
    for event in schedule.events:
        if isinstance(event, Propagate):
            computed = set()
        elif isinstance(event, Tick):
            computed.add((event.partition, event.index))
        elif isinstance(event, HoldUpdate) and (event.value.partition, event.value.index) not in computed:
            delayed.add(event.hold)
    return delayed


@dataclass(frozen=True, slots=True)
class Signal:
    """One column of a trajectory: the signal `local` (such as `cube.x`) of peer number `peer` (from 1) of
    a group.
    """

    group: str
    peer: int
    local: str
    unit: str
    role: str

    @property
    def name(self) -> str:
        """The complete name, such as `left[2].cube.x`."""
        return f"{self.group}[{self.peer}].{self.local}"

    @property
    def heading(self) -> str:
        """The name with its unit, such as `left[2].cube.x [m]`."""
        return f"{self.name} [{self.unit}]"


@dataclass(frozen=True, slots=True, eq=False)
class SignalSelection:
    """The recorded signals of a group: the signals `locals`, and `selected` (peers, signals)."""

    locals: tuple[LocalSignal, ...]
    selected: NDArray[np.bool_]


def choose(
    model: Model, available: Sequence[Sequence[LocalSignal]], patterns: Sequence[str]
) -> tuple[SignalSelection, ...]:
    """Return the signals of each group that match some pattern; without patterns, all signals.

    Parameters
    ----------
    model
        The model.
    available
        The recordable signals of a peer of each group.
    patterns
        Names with `*` for any text and `?` for any character. A name without a group matches the signal of
        every peer, a name with a group but no number that of every peer of the group.

    Raises
    ------
    ApcError
        E873 a pattern fits no signal.
    """
    tests = [(pattern, _expression(pattern)) for pattern in patterns]
    used: set[str] = set()
    choices = []
    for group, local_signals in zip(model.groups, available, strict=True):
        selected = np.full((group.count, len(local_signals)), not patterns)
        for pattern, test in tests:
            for index, local in enumerate(local_signals):
                matches = [any(test.fullmatch(text) for text in (local.name, f"{group.name}.{local.name}"))]
                if not matches[0] and ("[" in pattern or pattern.startswith(("*", group.name))):
                    names = (f"{group.name}[{i + 1}].{local.name}" for i in range(group.count))
                    matches = [bool(test.fullmatch(name)) for name in names]
                selected[:, index] |= matches
                used |= {pattern} if any(matches) else set()
        recorded = np.flatnonzero(selected.any(axis=0))
        locals_ = tuple(local_signals[index] for index in recorded.tolist())
        choices.append(SignalSelection(locals_, np.ascontiguousarray(selected[:, recorded])))
    for pattern in patterns:
        if pattern not in used:
            _raise_no_match(model, available, pattern)
    return tuple(choices)


def signals_of(model: Model, choices: Sequence[SignalSelection]) -> tuple[Signal, ...]:
    """Return the selected signals of all peers, in the order of the model."""
    return tuple(
        Signal(group.name, peer + 1, local.name, local.unit, local.role)
        for group, choice in zip(model.groups, choices, strict=True)
        for peer in range(group.count)
        for index, local in enumerate(choice.locals)
        if choice.selected[peer, index]
    )


def _expression(pattern: str) -> re.Pattern[str]:
    """Return the regular expression of a pattern; brackets are part of names."""
    return re.compile(re.escape(pattern.strip()).replace(r"\*", ".*").replace(r"\?", "."))


def _raise_no_match(model: Model, available: Sequence[Sequence[LocalSignal]], pattern: str) -> None:
    """Raise the error E873 for a pattern without a match, with the nearest name."""
    names = dict.fromkeys(local.name for local_signals in available for local in local_signals)
    names |= dict.fromkeys(
        f"{group.name}[1].{local.name}"
        for group, local_signals in zip(model.groups, available, strict=True)
        for local in local_signals
    )
    message = f"no signal matches {pattern[:80]!r}; the signals of a peer are {', '.join(list(names)[:12])}"
    near = nearest(pattern, names)
    fix, advice = (f"--signals {near}", "") if near else ("", f"use names such as {EXAMPLE}")
    raise ApcError(Diagnostic("E873", SourceLocation(model.origin.topology), message, fix=fix, advice=advice))
