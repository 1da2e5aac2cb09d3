"""Parsing of device names and frequencies.

Takes: a `Model`, texts.
Gives: `DevicePort`, `find_port`, `next_peer`; `read_frequencies`, `check_frequencies`, `ticks_in`.
Guarantees: no aliasing: a frequency beyond half the fastest clock rate raises an error.
Does not: check that the named part is a device.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.peer_counts import clocks_in_use
from apc.compiler.wording import no_more
from apc.parameter_values.parameters import resolve
from apc.support.option_value import option_value

Floats = NDArray[np.float64]

# The default of the highest frequency in Hz: hand forces are below this frequency.
HIGHEST = 60.0


@dataclass(frozen=True, slots=True)
class DevicePort:
    """A device: the index of its peer, from 0 over all groups, and its part, "" for the only device."""

    peer: int
    part: str


_PORT = re.compile(r"(?:(?P<group>[^.\[\]]+)\[(?P<number>[0-9]{1,9})\])?\.?(?P<part>.*)\Z")


def find_port(model: Model, text: str, option: str) -> DevicePort:
    """Return the device of a name such as `left[1].device`.

    Parameters
    ----------
    model
        The compiled model.
    text, option
        The name, and the command-line option for messages.

    Raises
    ------
    ApcError
        E936 an unknown peer or part.
    """
    counts = [group.count for group in model.groups]
    starts = np.cumsum([0, *counts]).tolist()
    names = [group.name for group in model.groups]
    matched = _PORT.match(text)
    assert matched is not None
    group, number, local = matched["group"], matched["number"], matched["part"]
    if group is None:
        first, _, remainder = local.partition(".")
        if first in names:
            group, number, local = first, "1", remainder
    states = [state.name for peer_type in model.peer_types for state in peer_type.states]
    parts = sorted({name.rpartition(".")[0] for name in states})
    parts += sorted({name for name in states if whole_and_index(name)[1]})  # a single axis
    named = local if local in parts else "device" if "device" in parts else next(iter(parts), "device")
    example = f'{option} "{names[0]}[1].{named}"'
    if group is not None and group not in names:
        message = f"{option}: unknown group of peers {group[:40]}"
        fix = nearest(group, names)
        fix = f'{option} "{fix}[{number}].{named}"' if fix else example
        raise ApcError(Diagnostic("E936", SourceLocation(model.origin.topology), message, fix=fix))
    index = 0 if group is None else names.index(group)
    peer = int(number or 1)
    if not 1 <= peer <= counts[index]:
        example = f'{option} "{names[index]}[{counts[index]}].{named}"'
        message = f"{option}: {names[index]} has peers 1 to {counts[index]:,}, got {peer}"
        raise ApcError(Diagnostic("E936", SourceLocation(model.origin.topology), message, fix=example))
    if local and local not in parts:
        message = f"{option}: unknown moving part {local[:40]}"
        fix = f'{option} "{names[index]}[{peer}].{nearest(local, parts) or named}"'
        raise ApcError(Diagnostic("E936", SourceLocation(model.origin.topology), message, fix=fix))
    return DevicePort(starts[index] + peer - 1, local)


def read_frequencies(model: Model, text: str | None, low: str, high: str | None, points: int) -> Floats:
    """Return the frequencies of the options in Hz: a list, or points in equal ratios between two limits.

    Parameters
    ----------
    model
        The compiled model.
    text
        Frequencies with units, separated by commas, or None.
    low, high, points
        The range, by default up to `HIGHEST` or half the fastest clock rate, and the number of points.

    Raises
    ------
    ApcError
        E935 no frequency above 0, an empty range, or no clock; the errors of `option_value`.
    """
    if text is not None:
        texts = [part.strip() for part in text.split(",") if part.strip()]
        values = [
            float(option_value("--frequencies", text, subject="frequency", unit="Hz")) for text in texts
        ]
        return np.array(values)
    first = float(option_value("--from", low, subject="frequency", unit="Hz"))
    last = min(HIGHEST, _fastest(model) / 2)
    if high is not None:
        last = float(option_value("--to", high, subject="frequency", unit="Hz"))
    if not 0 < first < last:
        message = f"no frequency above 0 Hz between {first:.6g} Hz and {last:.6g} Hz"
        if 0 < last <= first:
            message = f"--from {first:.6g} Hz is above --to {last:.6g} Hz"
        fix = '--from "0.1 Hz" --to "60 Hz"'
        if first > 0 and high is None:
            message = f"{first:.6g} Hz is not below {last:.6g} Hz, the default of --to"
            fix = f'--from "{first:.6g} Hz" --to "{_fastest(model) / 2:.6g} Hz"'
        raise ApcError(Diagnostic("E935", SourceLocation("--from"), message, fix=fix))
    return np.geomspace(first, last, points)


def _fastest(model: Model) -> float:
    """Return the rate of the fastest clock in Hz."""
    return float(1 / _fastest_clock(model)[0])


def _fastest_clock(model: Model) -> tuple[Fraction, Fraction]:
    """Return the period and phase of the fastest clock in use, in seconds."""
    timings = resolve(model).timings
    used = clocks_in_use(model)
    clocks = [clock for clock in model.clocks if clock.name in used]
    if not clocks:
        message = "the topology has no clock; transparency is defined for sampled forces"
        advice = "use a coupler with a clock, such as SampledSpringDamper"
        raise ApcError(Diagnostic("E935", SourceLocation(model.origin.topology), message, advice=advice))
    clock = min(clocks, key=lambda clock: timings[clock.period])
    return timings[clock.period], timings[clock.phase]


def next_peer(model: Model, port: DevicePort) -> int:
    """Return the index of the peer after a device's peer; of a single peer, its own."""
    return (port.peer + 1) % sum(group.count for group in model.groups)


def check_frequencies(model: Model, values: Floats) -> None:
    """Raise ApcError E935 for frequencies that are not positive, or beyond half the fastest clock rate."""
    most = _fastest(model) / 2
    location = SourceLocation(model.origin.topology)
    advice = f"use at most {no_more(most)} Hz"
    if not values.size or not np.isfinite(values).all() or values.min() <= 0:
        got = "none" if not values.size else f"{values.min():.6g} Hz"
        raise ApcError(Diagnostic("E935", location, "frequency", "above 0 Hz", got, "0.1 Hz"))
    if values.max() > most:
        message = f"{values.max():.6g} Hz is above the Nyquist frequency of the fastest clock"
        raise ApcError(Diagnostic("E935", location, message, advice=advice))


def ticks_in(model: Model, frame: float) -> list[Fraction] | None:
    """Return the ticks of the fastest clock in a frame, in seconds; None if it does not tick at time 0."""
    period, phase = _fastest_clock(model)
    if phase % period:
        return None
    return [number * period for number in range(round(frame / float(period)))]
