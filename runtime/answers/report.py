"""What a person reads: results as text of at most 80 columns.

Takes: results. Gives: text.
Guarantees: every number that decides something stands with its error.
Does not: compute.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from apc.compiler.words import WIDTH, counted, in_hertz, measured, wrapped

if TYPE_CHECKING:
    from apc.analysis.analysis import Analysis
    from apc.analysis.needs import Needs
    from apc.answers.answer import Answer
    from apc.compiler.compiled import CompiledSystem
    from apc.eigen.spectrum import Mode

MOST_ROWS = 16
DECIMALS = 6  # of a magnitude
MOST_UNFELT = 4  # names of what is left out beside the translations
LEAST_MAGNITUDE = 1e-6  # its six digits would show as zero
LARGE = 1e4  # a larger magnitude needs another notation to fit its column
MOVES_WIDTH = 30  # columns at most of what a mode moves, at least of what it is cut to
LEAST_WIDTH = 12
LEAST_SHARE = 0.005  # shows as zero
HEADINGS = ("magnitude", "shape", "times", "frequency", "damping", "moves most")

LINEARIZED = ", linearized at its start"

_WORDS = {
    "stable": "Every motion dies out.",
    "stable up to a common translation": (
        "Nothing ties the peers to the ground; moved together they stay where they are.\n"
        "Every other motion dies out."
    ),
    "drifts": "Nothing slows a common motion down. Every other motion dies out.",
    "unstable": "Some motion grows until the devices shake or hit their limits.",
}


def compile_report(system: CompiledSystem, needs: Needs, target: Path, difference: float) -> str:
    """Return what `apc compile` prints.

    Parameters
    ----------
    system, needs
        The compiled scene and what it keeps.
    target
        The file written.
    difference
        The largest relative difference the self-check found.
    """
    ticks = ", ".join(
        f"{name} ticks {count} times" if count != 1 else f"{name} once" for name, count in needs.ticks
    )
    lines = [
        f"{system.name} → {target}",
        *_note(str(replace(needs, pairs=()))),  # they follow, with their reason
        f"  frame {_time(float(needs.frame))}: {ticks or 'no clock is used, any frame will do'}",
        *_note(f"self-check: {_self_check(system, difference)}"),
    ]
    for note in (*_pairwise(system), *(f"left out: {name}, as {reason}" for name, reason in system.dropped)):
        lines += _note(note)
    return "\n".join(lines)


def _self_check(system: CompiledSystem, difference: float) -> str:
    from apc.analysis.selfcheck import skipped  # an analysis checks nothing

    left_out = skipped(system)
    compared = f"one frame event by event and lifted differ by {difference:.0e}"
    if not left_out:
        return compared
    if len(left_out) == len(system.kinds):
        return "no frame is compared, as no peer here is linear"
    return f"{compared} (not {' and '.join(left_out)}, which is not linear)"


def _pairwise(system: CompiledSystem) -> Iterator[str]:
    """Yield what is evaluated once a pair of peers, and why it can't be once a peer."""
    found = {
        receive.name: receive
        for kind in system.kinds
        for clock in kind.clocks
        for receive in clock.receives
        if receive.edge is not None or receive.operator in ("max", "min")
    }
    for name, receive in found.items():
        why = (
            f"what it runs over is not linear in what the others send over {receive.link}"
            if receive.edge is not None and receive.operator in ("sum", "mean")
            else f"a {receive.operator} can't be taken apart into one number a peer"
        )
        yield f"costs N²: {name} is evaluated once a pair of peers, as {why}"


def timings_report(taken: Sequence[tuple[str, float]]) -> str:
    """Return what `apc compile --timings` prints: stages and their seconds."""
    total = sum(seconds for _, seconds in taken)
    rows = [*taken, ("all", total)]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name:<{width}}  {seconds * 1e3:8.1f} ms" for name, seconds in rows)


def analysis_report(result: Analysis) -> str:
    """Return what `apc analyze` prints: the verdict in words, the numbers, the modes as a table."""
    lines = [f"{result.topology}: {result.verdict}{LINEARIZED if result.linearized else ''}"]
    for note in result.left_out:
        lines += _note(note)
    lines.append("")
    words = _WORDS.get(result.verdict, "The spectral radius lies nearer to 1 than its error bound.")
    if result.linearized:
        words = words.replace("Nothing ties", "To first order, nothing ties", 1)
    if not result.states_per_peer:
        words = "Nothing here is free to move."
    lines += [f"  {line}" for line in words.splitlines()]
    removed = ""
    if result.translations:
        removed = f", {counted(result.translations, 'translation')} left out"
    lines += [
        "",
        f"  spectral radius  {measured(result.spectral_radius, result.spectral_radius_error)}"
        f" per frame of {_time(result.frame_s)}",
        f"  peers            {result.peers}, {result.states_per_peer} states each",
        f"  method           {result.method}{removed}",
    ]
    if result.proof:
        lines.append(f"  proof            {result.proof}")
    if result.unfelt:
        names = f"{', '.join(result.unfelt[:MOST_UNFELT])}{', …' if len(result.unfelt) > MOST_UNFELT else ''}"
        told = f"{names}, which nothing that moves reads at these values"
        lines += wrapped(told, "  left out         ", " " * 19)
    lines += ["", _mode_table(result.modes)]
    for note in result.notes:
        lines += _note(note)
    return "\n".join(lines)


def answer_report(found: Answer) -> str:
    """Return what `apc analyze` prints: the analysis, and what stands beside it."""
    parts = [analysis_report(found.analysis), str(found.sensitivities), str(found.margins)]
    if found.contact_modes is not None:
        parts.append(str(found.contact_modes))
    if found.detailed:
        parts.append(str(found.conventions))
    elif found.conventions.warning:
        parts.append("\n".join(wrapped(f"Warning: {found.conventions.warning}")))
    if found.box is not None:
        parts.append(str(found.box))
    return "\n\n".join(parts)


def _mode_table(modes: tuple[Mode, ...]) -> str:
    # What can't be told from zero is counted only: its rounding differs from machine to machine.
    alive = [mode for mode in modes if _is_alive(mode)]
    rows = [mode for mode in alive if mode.eigenvalue.imag >= -mode.error]  # a conjugate pair is one row
    shown = rows[:MOST_ROWS]
    dead = [mode for mode in modes if not _is_alive(mode)]
    rest = [*dead, *rows[MOST_ROWS:]]
    # A mode not told from zero may be any size up to its error.
    least = max(shown[-1].magnitude if shown else 0.0, 2 * LEAST_MAGNITUDE)
    unsure = sum(not mode.magnitude + mode.error <= least for mode in dead)
    text = "\n".join(_table_lines([HEADINGS, *(_cells(mode) for mode in shown)])) if shown else ""
    if not rest:
        return text or "  nothing moves but that"
    if unsure:
        many = "all" if unsure == len(rest) > 1 else str(unsure)
        told = f"{counted(len(rest), 'mode')} {'more' if shown else ''} (--json lists all),"
        told += (
            f" {many} of them known too roughly to say how fast {'it dies' if unsure == 1 else 'they die'}"
        )
    elif shown:
        told = f"{len(rest)} faster-dying {'one' if len(rest) == 1 else 'ones'} (--json lists all)"
    else:
        ends = "dies" if len(rest) == 1 else "die"
        told = f"{counted(len(rest), 'mode')} {ends} out within a frame (--json lists all)"
    return "\n".join([*text.splitlines(), *_note(f"and {told}" if shown else told)])


def _is_alive(mode: Mode) -> bool:
    """Say whether a mode is told from zero."""
    return mode.magnitude > max(mode.error, LEAST_MAGNITUDE)


def _cells(mode: Mode) -> tuple[str, ...]:
    return (
        _magnitude(mode),
        mode.shape,
        str(mode.multiplicity),
        in_hertz(mode.frequency_hz) if mode.frequency_hz else "–",
        "–" if isnan(mode.damping_ratio) else f"{mode.damping_ratio:.3g}",
        _leading(mode),
    )


def _magnitude(mode: Mode) -> str:
    """Return a magnitude to six digits behind the point, fewer where its error leaves them open."""
    if mode.magnitude >= LARGE:
        return f"{mode.magnitude:.6e}"
    known = -math.floor(math.log10(mode.error)) - 1 if 0 < mode.error < math.inf else DECIMALS
    decimals = min(max(known, 0), DECIMALS)
    return f"{mode.magnitude:.{decimals}f}" + " " * (DECIMALS - decimals)


def _table_lines(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """Yield the lines of a table: numbers to the right, words to the left, the last column wrapped."""
    widths = [max(len(row[place]) for row in rows) for place in range(len(HEADINGS) - 1)]
    room = WIDTH - 2 - sum(widths) - 2 * len(widths)
    last = max(min(MOVES_WIDTH, room), LEAST_WIDTH)
    for row in rows:
        cells = [
            f"{cell:<{width}}" if heading == "shape" else f"{cell:>{width}}"
            for heading, cell, width in zip(HEADINGS, row, widths, strict=False)
        ]
        start = f"  {'  '.join(cells)}  "
        for line in textwrap.wrap(row[-1], last, break_on_hyphens=False) or [""]:
            yield f"{start}{line}".rstrip()
            start = " " * len(start)


def _leading(mode: Mode) -> str:
    largest = sorted(mode.participation, key=lambda item: -item[1])[:2]
    return ", ".join(f"{name} {share:.0%}" for name, share in largest if share >= LEAST_SHARE)


def _time(seconds: float) -> str:
    return f"{seconds * 1e3:.6g} ms" if seconds < 1 else f"{seconds:.6g} s"


def _note(text: str) -> list[str]:
    return wrapped(text, "  ", "    ")
