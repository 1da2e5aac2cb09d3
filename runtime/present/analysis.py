"""Analyses as text, plain data, a picture: the verdict, what stands beside it, what a compiled scene needs.

Takes: results of `analysis`, and the `Answer` they make together; a `Locus`.
Gives: their texts and documents; `compile_text`; `analysis_picture`, the eigenvalues over the unit circle,
and `locus_picture`, where they go.
Guarantees: every number that decides something stands with its error. In a picture what decides is in sight,
and so are the unit circle and every eigenvalue; nothing is written over a mark, what marks mean stands beside
the circle.
Does not: compute, or need a display.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.words import counted, in_hertz, wrapped
from apc.optional import need
from apc.present.forms import (
    LINEARIZED,
    NEAR,
    Lines,
    Plain,
    axis_label,
    document,
    labelled,
    listed,
    notes,
    picked,
    quantity,
    radius_text,
    record,
    sentences,
    table,
)
from apc.present.pictures import COLOURS, legend_below, new_figure

if TYPE_CHECKING:
    from apc.analysis.analysis import Analysis
    from apc.analysis.box_proof import BoxProof, ChangingDelay
    from apc.analysis.contact_modes import ContactMode, ContactModes
    from apc.analysis.conventions import Conventions, Outcome
    from apc.analysis.needs import Needs, SiteNeeds
    from apc.analysis.paper import NamedMatrix, PaperRoute
    from apc.analysis.switching import Switching
    from apc.answer import Answer, NetworkAnswer
    from apc.compiler.compiled import CompiledSystem
    from apc.eigen.spectrum import Mode
    from apc.frame.names import Range
    from apc.vary.locus import Locus

MOST_ROWS = 16
MORE_CELLS = 10  # times as many as left a box open, to try next
DECIMALS = 6  # of a magnitude
MOST_UNFELT = 4  # names of what is left out beside the translations
LEAST_MAGNITUDE = 1e-6  # its six digits would show as zero
LARGE = 1e4  # a larger magnitude needs another notation to fit its column
LEAST_SHARE = 0.005  # shows as zero
HEADINGS = ("magnitude", "shape", "times", "frequency", "damping", "moves most")

NOT_PLAYED = "not predicted and played: --buzz"
SHOWN = 1e-9  # digits of a contact mode's spectral radius that its column has room for

_WORDS = {
    "stable": "Every motion dies out.",
    "stable up to a common translation": (
        "Nothing ties the peers to the ground; moved together they stay where they are.\n"
        "Every other motion dies out."
    ),
    "stable up to a common rotation": (
        "Nothing holds the peers' angles; turned together they stay as they are.\n"
        "Every other motion dies out."
    ),
    "drifts": "Nothing slows a common motion down. Every other motion dies out.",
    "unstable": "Some motion grows until the devices shake or hit their limits.",
}

SIZE = (5.6, 4.6)  # inches
MOST_NAMED = 5  # modes
MARKS = "os^Dv"
LETTERS = 75  # of a line of a title


def compile_text(system: CompiledSystem, needs: Needs, target: Path) -> Lines:
    """Yield what `apc compile` prints.

    Parameters
    ----------
    system, needs
        The compiled scene and what it keeps.
    target
        The file written.
    """
    ticks = ", ".join(
        f"{name} ticks {count} times" if count != 1 else f"{name} once" for name, count in needs.ticks
    )
    yield f"{system.name} → {target}"
    yield from notes(str(replace(needs, pairs=())))  # they follow, with their reason
    yield f"  frame {quantity(float(needs.frame), 's')}: {ticks or 'no clock is used, any frame will do'}"
    yield from warning_lines(system.warnings)
    dropped = (f"left out: {name}, as {reason}" for name, reason in system.dropped)
    yield from notes(*_pairwise(system), *dropped)


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


def analysis_text(result: Analysis) -> Lines:
    """Yield what `apc analyze` prints: the verdict in words, the numbers, the modes as a table."""
    words = _WORDS.get(result.verdict, "The spectral radius lies nearer to 1 than its error bound.")
    named = (("translation", result.translations), ("rotation", result.rotations))
    free = " and ".join(counted(count, noun) for noun, count in named if count)
    if result.translations + result.rotations > 1 and result.verdict.startswith("stable up to"):
        words = (
            f"{free} are held back by nothing, of all peers together or of some beside others: moved so, "
            "they stay where they are. Every other motion dies out."
        )
    if result.linearized:
        words = f"To first order, {words[0].lower()}{words[1:]}"
    if result.linearized and result.stable is not True:
        words += "\nWhat it does in time is played: apc simulate"
    if not result.states_per_peer:
        words = "Nothing here is free to move."
    yield f"{result.topology}: {result.verdict}{LINEARIZED if result.linearized else ''}"
    yield from notes(*result.left_out)
    yield ""
    yield from sentences(*words.splitlines())
    yield ""
    radius = radius_text(result.spectral_radius, result.spectral_radius_error, result.beyond)
    unfelt = f"{listed(result.unfelt, MOST_UNFELT)}, which nothing that moves reads at these values"
    yield from labelled(
        ("spectral radius", f"{radius} per frame of {quantity(result.frame_s, 's')}"),
        ("peers", f"{result.peers}, {result.states_per_peer} states each"),
        ("method", result.method + (f", {free} left out" if free else "")),
        ("proof", result.proof),
        ("left out", unfelt if result.unfelt else ""),
    )
    yield ""
    yield from _mode_table(result.modes)
    yield from notes(*result.notes)


def analysis_document(result: Analysis) -> Plain:
    """Return what `apc analyze --json` prints of the analysis itself."""
    return record(result, {"modes": [_mode_document(mode) for mode in result.modes]})


def _mode_document(mode: Mode) -> Plain:
    (motion,) = mode.motion
    moved = record(motion, {"participation": dict(motion.participation)})
    return record(mode, {"motion": ..., **moved})


def answer_text(found: Answer) -> Lines:
    """Yield what `apc analyze` prints: the analysis, and what stands beside it."""
    conventions, topology = found.conventions, found.analysis.topology
    warned = f"Warning: {conventions.warning}" if conventions.warning else ""
    nominal: tuple[object, ...] = (found.analysis, found.sensitivities, found.margins)
    if found.network is not None and not found.nominal:
        nominal = (_in_short(found.analysis),)
    parts = (
        found.box,
        found.network,
        *nominal,
        found.contact_modes,
        found.switching,
        found.buzz,
        "\n".join(wrapped(f"{topology}: {found.no_buzz}")) if found.no_buzz else "",
        conventions if found.detailed else "\n".join(wrapped(warned)),
    )
    first, _, rest = "\n\n".join(filter(None, map(str, filter(None, parts)))).partition("\n")
    yield first
    yield from warning_lines(found.warnings)
    yield rest


def _in_short(found: Analysis) -> str:
    """Return the verdict of the nominal network, beside that of the network as it is."""
    radius = radius_text(found.spectral_radius, found.spectral_radius_error, found.beyond)
    text = (
        f"With every packet on time: {found.verdict}, spectral radius {radius} per frame of "
        f"{found.frame_s * 1000:.6g} ms (apc analyze --nominal says all of it)."
    )
    return "\n".join(sentences(text))


def warning_lines(warnings: Sequence[str]) -> Lines:
    """Yield the warnings of a topology as lines to stand under a sentence."""
    return notes(*(f"Warning: {text}" for text in warnings))


def network_answer_text(found: NetworkAnswer) -> Lines:
    """Yield the verdict over the network as it is, and what moves it."""
    yield f"{found.verdict}\n\n{found.sensitivities}\n\n{found.margins}"


def network_answer_document(found: NetworkAnswer) -> Plain:
    """Return the verdict over the network as it is, and what moves it, as plain data."""
    return found.verdict.to_dict() | {
        "sensitivities": found.sensitivities.to_dict(),
        "margins": document(found.margins.rows),
        "margins_note": found.margins.note,
    }


def answer_document(found: Answer) -> Plain:
    """Return what `apc analyze --json` prints: the analysis with more keys."""
    told = found.analysis.to_dict()
    told |= picked(found, "network", "sensitivities", "contact_modes", "switching", "buzz")
    told |= {
        "margins": document(found.margins.rows),
        "margins_note": found.margins.note,
        "buzz_note": "" if found.buzz else found.no_buzz or NOT_PLAYED,
        "warnings": [*found.warnings, *filter(None, (found.conventions.warning,))],
    }
    if found.detailed:
        told["conventions"] = found.conventions.to_dict()
    if found.box is not None:
        told["box"] = found.box.to_dict()
    return told


def _mode_table(modes: Sequence[Mode]) -> Lines:
    # What can't be told from zero is counted only: its rounding differs from machine to machine.
    alive = [mode for mode in modes if _is_alive(mode)]
    rows = [mode for mode in alive if mode.eigenvalue.imag >= -mode.error]  # a conjugate pair is one row
    shown = rows[:MOST_ROWS]
    dead = [mode for mode in modes if not _is_alive(mode)]
    left = len(dead) + len(rows) - len(shown)
    # A mode not told from zero may be any size up to its error.
    least = max(shown[-1].magnitude if shown else 0.0, 2 * LEAST_MAGNITUDE)
    unsure = sum(not mode.magnitude + mode.error <= least for mode in dead)
    if shown:
        yield from table([HEADINGS, *map(_cells, shown)], "><>>><")
    if unsure:
        many = "all" if unsure == left > 1 else str(unsure)
        ends = "it dies" if unsure == 1 else "they die"
        told = f"{counted(left, 'mode')} {'more' if shown else ''} (--json lists all),"
        told += f" {many} of them known too roughly to say how fast {ends}"
    elif shown:
        told = f"{left} faster-dying {'one' if left == 1 else 'ones'} (--json lists all)"
    else:
        told = (
            f"{counted(left, 'mode')} {'dies' if left == 1 else 'die'} out within a frame (--json lists all)"
        )
    if left:
        yield from notes(f"and {told}" if shown else told)
    elif not shown:
        yield "  nothing moves but that"


def _is_alive(mode: Mode) -> bool:
    """Say whether a mode is told from zero."""
    return mode.magnitude > max(mode.error, LEAST_MAGNITUDE)


def _cells(mode: Mode) -> tuple[str, ...]:
    return (
        _magnitude(mode),
        mode.shape,
        str(mode.multiplicity),
        in_hertz(mode.frequency_hz) if mode.frequency_hz else "–",
        "–" if math.isnan(mode.damping_ratio) else f"{mode.damping_ratio + 0.0:.3g}",
        _leading(mode),
    )


def _magnitude(mode: Mode) -> str:
    """Return a magnitude to six digits behind the point, fewer where its error leaves them open."""
    if mode.error < abs(mode.magnitude - 1) < 10.0**-DECIMALS / 2:
        return f"1 {'−' if mode.magnitude < 1 else '+'} {abs(mode.magnitude - 1):.0e}"
    if mode.magnitude >= LARGE:
        return f"{mode.magnitude:.6e}"
    known = -math.floor(math.log10(mode.error)) - 1 if 0 < mode.error < math.inf else DECIMALS
    decimals = min(max(known, 0), DECIMALS)
    return f"{mode.magnitude:.{decimals}f}" + " " * (DECIMALS - decimals)


def _leading(mode: Mode) -> str:
    largest = sorted(mode.participation, key=lambda item: -item[1])[:2]
    return ", ".join(f"{name} {share:.0%}" for name, share in largest if share >= LEAST_SHARE)


def needs_text(found: Needs) -> Lines:
    """Yield what a scene needs in one sentence."""
    several = len(found.sites) > 1
    sites = "; ".join(f"{site.name}: {_site(site)}" if several else _site(site) for site in found.sites)
    whole = found.peers > 1 and sum(count for count, _ in found.systems) == 1
    noun = "determinant" if found.method == "determinant" else "system" if whole else "mode"
    systems = " and ".join(f"{counted(count, noun)} of {size}" for count, size in found.systems)
    analysed = f"not analysed: {found.refused}" if found.refused else f"analysed as {systems}"
    pairs = "".join(f"; costs N²: {name} is evaluated once a pair of peers" for name in found.pairs)
    yield f"{sites}, {counted(found.peers, 'peer')}; {analysed}{pairs}"


def _site(found: SiteNeeds) -> str:
    parts = [f"{found.motion} motion"]
    if found.remembered:
        parts.append(f"{found.remembered} delayed force")
    if found.packets:
        parts.append(f"{found.packets} network")
    return f"{found.states} states a peer ({', '.join(parts)})"


def box_proof_text(found: BoxProof) -> Lines:
    """Yield what was proved of a box."""
    where = [
        f"  {interval.free.label} = {quantity(value, interval.unit, 12)}"
        for interval, value in zip(found.ranges, found.point, strict=False)  # a proved box has no point
    ]
    cells = counted(found.cells, "cell")
    said = f"undecided, {100 * found.open_share:.3g} % of the box is left open ({cells})"
    if found.stable is not None:
        whole = f"proved {found.verdict} for every value in the box ({cells})"
        said = whole if found.stable else "not stable in all of the box"
    yield f"{found.topology}:"
    for text in (*found.left_out, said):
        yield from wrapped(text)
    yield from (f"  {range_text(interval)}" for interval in found.ranges)
    if found.stable is False:
        yield f"proved {found.verdict} at"
        yield from where
    elif found.stable is None and found.point:  # else nothing was looked at, as its notes say
        yield "among others around"
        yield from where
        yield from wrapped(f"more cells may decide it: --cells {MORE_CELLS * found.cells}")
    if found.changing is not None:
        yield ""
        yield from wrapped(_changing(found.changing, found.ranges[0]))
    yield from notes(*found.notes)


def _changing(found: ChangingDelay, over: Range) -> str:
    """Return what is proved of a delay that changes from packet to packet, in a sentence."""
    low, high = (quantity(float(number), over.unit, 9) for number in (over.low, over.high))
    said = [found.note or "open whether it stays stable"]
    if found.unstable is not None:
        said = [f"unstable if by turns {found.unstable[0]} packets take {low} and {found.unstable[1]} {high}"]
    if found.proved_to == float(over.high):
        said = ["stable, proved by the small gain theorem"]
    elif found.proved_to is not None:
        to = quantity(found.proved_to, over.unit, 9)
        said = [f"stable from {low} to {to}, proved by the small gain theorem", f"over all of it {said[0]}"]
    return f"However the delay changes from packet to packet: {'; '.join(said)}."


def range_text(found: Range) -> str:
    """Return a parameter and its range in words."""
    low, high = (quantity(float(number), found.unit, 9) for number in (found.low, found.high))
    return f"{found.free.label} from {low} to {high}"


def range_document(found: Range) -> Plain:
    """Return a parameter and its range as plain data."""
    return {"parameter": found.free.label, "unit": found.unit, "range": document((found.low, found.high))}


def box_proof_document(found: BoxProof) -> Plain:
    """Return what was proved of a box as plain data."""
    return {
        **picked(found, "topology", "left_out", "verdict", "stable", "cells", "open_share", "notes"),
        "box": [range_document(interval) for interval in found.ranges],
        "unstable_at": list(found.point) if found.stable is False else None,
        "open_around": list(found.point) if found.stable is None and found.point else None,
        "changing": found.changing and picked(found.changing, "proved_to", "unstable", "note"),
    }


def contact_modes_text(found: ContactModes) -> Lines:
    """Yield the modes of contact as a table, and which is unstable in words."""
    if not found.modes:
        yield f"{found.topology}: no part switches"
        yield from found.notes
        return
    yield from wrapped(f"{found.topology}: {found.summary}")
    yield ""
    yield from (f"  {name} on: it follows the motion; off: it does not" for name in found.parts)
    rows = [("spectral radius", "frequency", "verdict", "")]
    refused = []
    for mode in found.modes:
        if mode.refusal:
            rows.append(("–", "–", "not analysed", mode.name))
            refused.append(f"{mode.name}: not analysed: {mode.refusal}")
            continue
        error = max(mode.spectral_radius_error, SHOWN if abs(mode.spectral_radius - 1) > NEAR else 0.0)
        radius = radius_text(mode.spectral_radius, error, mode.beyond)
        frequency = in_hertz(mode.frequency_hz) if mode.frequency_hz else "–"
        verdict = mode.verdict.partition(" up to ")[0].partition(":")[0]
        rows.append((radius, frequency, verdict + "*" * mode.linearized, mode.name))
    yield ""
    yield from table(rows, "<><<")
    if any(mode.linearized for mode in found.modes):
        yield "\n  * near the start values: this piece is not linear"
    yield from notes(*refused, *found.notes)


def contact_modes_document(found: ContactModes) -> Plain:
    """Return the modes of contact as plain data."""
    modes = [_analysed(mode, {"on": dict(mode.on)}, "frequency_hz") for mode in found.modes]
    return record(found, {"unstable": found.unstable, "modes": modes})


def switching_text(found: Switching) -> Lines:
    """Yield whether contacts may open and close at will, in words."""
    reach = found.reach
    if found.stable:
        said = "proved stable by the circle criterion"
        if found.jumps:
            said += f" (as {found.jumps} jumps where it opens, within bounds: it need not come to rest)"
    else:
        said = f"{'cannot be proved' if found.stable is False else 'not decided'}: {found.reason}"
    if reach is not None and math.isfinite(reach):
        times = f"{math.floor(reach * 10**DECIMALS) / 10**DECIMALS:.6g}"
        said += f"; the criterion holds for contacts up to {times} times as stiff"
    elif reach is not None:
        said += "; the criterion holds however stiff the contacts"
    yield from wrapped(f"{found.topology}, contacts that open and close at will: {said}", "", "  ")


def switching_document(found: Switching) -> Plain:
    """Return whether contacts may open and close at will, as plain data."""
    return {"stable": found.stable, **record(found)}


def _analysed(found: ContactMode | Outcome, instead: Plain, *more: str) -> Plain:
    """Return plain data of what may have been refused: then there are no numbers of an analysis."""
    if not found.verdict:
        instead |= dict.fromkeys(("verdict", "spectral_radius", "spectral_radius_error", *more))
    return record(found, instead)


def conventions_text(found: Conventions) -> Lines:
    """Yield what every convention leads to."""
    from apc.analysis.conventions import (  # loaded where there are outcomes, and else not needed
        DEFAULT,
        ORDERS,
    )

    headline = "the same verdict under every convention"
    if not found.repeated:
        headline = found.not_repeated
    elif found.flips:
        headline = "the verdict depends on the conventions"
    yield f"{found.topology}: {headline}\n"
    for number, outcome in enumerate(found.outcomes, 1):
        radius = radius_text(outcome.spectral_radius, outcome.spectral_radius_error, outcome.beyond)
        yield f"  {number}  {outcome.verdict or 'not analysed'}"
        yield f"     spectral radius {radius}" if outcome.verdict else f"     {outcome.refusal}"
        yield from (f"     {departure}" for departure in outcome.departures or (DEFAULT,))
        if outcome.start:
            yield f"     heard before the first packet: {outcome.start}"
        yield f"     {len(outcome.orders)} of {ORDERS} orders, such as {' < '.join(outcome.orders[0])}"
    if found.repeated and not found.start_matters:
        yield "\n  What is heard before the first packet can't change the verdict."


def conventions_document(found: Conventions) -> Plain:
    """Return what every convention leads to as plain data."""
    outcomes = [_analysed(outcome, {}) for outcome in found.outcomes]
    return record(found, {"flips": found.flips, "repeated": found.repeated, "outcomes": outcomes})


def paper_route_text(found: PaperRoute) -> Lines:
    """Yield the shapes of the paper's matrices, a line each."""
    yield f"ratio {found.ratio}, frame {found.frame_s * 1e3:.6g} ms"
    for field in fields(found):
        matrix = getattr(found, field.name)
        if hasattr(matrix, "columns"):
            which, mark, of = field.name.partition("_")
            name = "A_cl" if which == "closed" else f"{which.upper()}{mark}{of.replace('d', 'D')}"
            yield f"  {name:<6} {len(matrix.rows):>4} × {len(matrix.columns)}"


def matrix_text(found: NamedMatrix) -> Lines:
    """Yield the shape of a matrix and the ends of its names."""
    rows, columns = found.rows, found.columns
    ends = f": {rows[0]} … {rows[-1]} by {columns[0]} … {columns[-1]}" if found.values.size else ""
    yield f"{len(rows)} × {len(columns)}{ends}"


def analysis_picture(result: Analysis, ax: Any = None) -> Any:
    """Draw the eigenvalues of a frame over the unit circle; return the matplotlib Axes.

    Parameters
    ----------
    result
        The analysis whose modes are drawn, rigid ones left out.
    ax
        The matplotlib Axes to draw into; one of a figure of its own if not given.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    ax = _circle(ax)
    modes = [mode for mode in result.modes if mode.eigenvalue.imag >= 0]  # of a pair one
    rest = [mode.eigenvalue for mode in modes[MOST_NAMED:]]
    for place, mode in enumerate(modes[:MOST_NAMED]):
        times = f" × {mode.multiplicity}" if mode.multiplicity > 1 else ""
        label = f"{mode.magnitude:.4f}{times}, {in_hertz(mode.frequency_hz)}, {mode.shape}"
        _mark(ax, mode.eigenvalue, MARKS[place % len(MARKS)], COLOURS[1 + place], label)
    _mark(ax, rest, ".", "0.4", f"{len(rest)} that die out faster")
    seconds = result.settling_s
    settles = "" if seconds is None else f"; settles within 2 % in {seconds:.3g} s"
    radius = f"spectral radius {result.spectral_radius:.6g} per frame of {1e3 * result.frame_s:g} ms{settles}"
    _entitle(ax, [f"{result.topology}: {result.verdict}", radius])
    return ax


def locus_picture(found: Locus, ax: Any = None) -> Any:
    """Draw where eigenvalues go as a parameter grows; return the matplotlib Axes.

    Parameters
    ----------
    found
        The eigenvalues by value.
    ax
        The matplotlib Axes to draw into; one of a figure of its own if not given.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    ax = _circle(ax)
    of = found.critical
    points = np.concatenate(found.eigenvalues)  # conjugates are among them
    colours = np.repeat(found.values, [len(eigenvalue) for eigenvalue in found.eigenvalues])
    drawn = ax.scatter(points.real, points.imag, c=colours, s=5, linewidths=0, cmap="viridis", zorder=3)
    ax.figure.colorbar(drawn, ax=ax, label=axis_label(of.parameter, of.unit))
    _mark(ax, found.now, "x", COLOURS[2], f"now, {quantity(of.present, of.unit)}")
    for place, crossing in enumerate(of.crossings[:MOST_NAMED]):
        if not found.values.size or not found.values[0] <= crossing.value <= found.values[-1]:
            continue
        nearest = found.eigenvalues[int(np.abs(found.values - crossing.value).argmin())]
        at = nearest[np.abs(np.abs(nearest) - 1).argmin()]
        told = "" if np.isnan(crossing.frequency_hz) else f", {in_hertz(crossing.frequency_hz)}"
        label = f"changes at {quantity(crossing.value, of.unit)}{told}"
        _mark(ax, at / abs(at), MARKS[place], "none", label)
    _entitle(ax, [f"{of.topology}: eigenvalues of a frame of {1e3 * found.frame_s:g} ms, packets on time"])
    return ax


def _circle(ax: Any) -> Any:
    """Return an Axes with the unit circle in it, to scale."""
    patches = need("matplotlib.patches", "plot")
    if ax is None:
        ax = new_figure(SIZE).subplots()
    ax.add_patch(patches.Circle((0, 0), 1, facecolor="none", edgecolor="0.4", linewidth=0.9))
    for line in (ax.axhline, ax.axvline):
        line(0, color="0.8", linewidth=0.6, zorder=0)
    ax.set_aspect("equal", adjustable="datalim")
    ax.update_datalim([(-1.05, -1.05), (1.05, 1.05)])
    ax.set_xlabel("real part")
    ax.set_ylabel("imaginary part")
    return ax


def _mark(ax: Any, values: Any, mark: str, colour: str, label: str) -> None:
    """Draw eigenvalues (k,) and their conjugates."""
    points = np.append(values, np.conj(values))
    if not points.size:
        return
    look = {"markerfacecolor": colour, "markeredgecolor": "0.1" if colour == "none" else colour}
    size = {".": 4, "x": 7}.get(mark, 9 if colour == "none" else 6)
    ax.plot(points.real, points.imag, mark, markersize=size, label=label, zorder=4, **look)


def _entitle(ax: Any, lines: Sequence[str]) -> None:
    ax.autoscale_view()
    ax.set_title("\n".join(text for line in lines for text in textwrap.wrap(line, LETTERS)), fontsize=9)
    legend_below(ax)
