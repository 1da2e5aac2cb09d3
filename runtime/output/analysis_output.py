"""Analyses as text, plain data and pictures: verdict, additional results, model size.

Takes: results of `analysis`, and the `AnalysisReport` they make together; a `Locus`.
Gives: their texts and documents; `compile_text`; `analysis_picture`, the eigenvalues over the unit circle,
and `locus_picture`, where they go; `warning_lines`, `changing_text`, `range_text`, `range_document`.
Guarantees: every number that a verdict depends on has its error bound. A picture shows the unit circle, every
eigenvalue and the critical ones. No text covers a mark, and the legend is outside the circle.
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

from apc.compiler.wording import counted, in_hertz, wrapped
from apc.optional import need
from apc.output.formatting import (
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
from apc.output.pictures import COLOURS, legend_below, new_figure
from apc.verdict import StabilityVerdict

if TYPE_CHECKING:
    from apc.analysis.analysis import Analysis
    from apc.analysis.arbitrary_switching import ArbitrarySwitching
    from apc.analysis.contact_modes import ContactMode, ContactModes
    from apc.analysis.event_order import EventOrder, Outcome
    from apc.analysis.model_size import ModelSize, SubsystemSize
    from apc.analysis.paper_method import NamedMatrix, PaperMethod
    from apc.analysis.robust_stability import ChangingDelay, RobustStability
    from apc.analysis_report import AnalysisReport, NetworkAnswer
    from apc.compiler.compiled import Model
    from apc.eigen.spectrum import Mode
    from apc.frame.parameter_names import Range
    from apc.parameter_studies.root_locus import Locus

MOST_ROWS = 16
MORE_CELLS = 10  # times as many as left a box open, to try next
DECIMALS = 6  # of a magnitude
MOST_UNOBSERVABLE = 4  # names of excluded modes other than translations
LEAST_MAGNITUDE = 1e-6  # its six digits would show as zero
LARGE = 1e4  # a larger magnitude needs another notation to fit its column
LEAST_SHARE = 0.005  # shows as zero
HEADINGS = ("magnitude", "shape", "times", "frequency", "damping", "moves most")

NOT_SIMULATED = "not predicted and played: --limit-cycle"
SHOWN = 1e-9  # digits of a contact mode's spectral radius that its column has room for

_WORDS = {
    StabilityVerdict.STABLE: "Every motion dies out.",
    StabilityVerdict.STABLE_TRANSLATING: (
        "Nothing ties the peers to the ground; moved together they stay where they are.\n"
        "Every other motion dies out."
    ),
    StabilityVerdict.STABLE_TURNING: (
        "Nothing holds the peers' angles; turned together they stay as they are.\n"
        "Every other motion dies out."
    ),
    StabilityVerdict.DRIFTS: "Nothing slows a common motion down. Every other motion dies out.",
    StabilityVerdict.UNSTABLE: "Some motion grows until the devices shake or hit their limits.",
}

SIZE = (5.6, 4.6)  # inches
MOST_NAMED = 5  # modes
MARKS = "os^Dv"
LETTERS = 75  # of a line of a title


def compile_text(system: Model, model_size: ModelSize, target: Path) -> Lines:
    """Yield the output of `apc compile`.

    Parameters
    ----------
    system, model_size
        The model and what it keeps.
    target
        The file written.
    """
    ticks = ", ".join(
        f"{name} ticks {count} times" if count != 1 else f"{name} once" for name, count in model_size.ticks
    )
    yield f"{system.name} → {target}"
    yield from notes(str(replace(model_size, pairs=())))  # they follow, with their reason
    yield (
        f"  frame {quantity(float(model_size.frame), 's')}: {ticks or 'no clock is used, any frame will do'}"
    )
    yield from warning_lines(system.warnings)
    dropped = (f"left out: {name}, as {reason}" for name, reason in system.dropped)
    yield from notes(*_pairwise(system), *dropped)


def _pairwise(system: Model) -> Iterator[str]:
    """Yield the pairwise evaluations, and the reasons why they are not per peer."""
    result = {
        receive.name: receive
        for peer_type in system.peer_types
        for clock in peer_type.clocks
        for receive in clock.receives
        if receive.edge is not None or receive.operator in ("max", "min")
    }
    for name, receive in result.items():
        why = (
            f"what it runs over is not linear in what the others send over {receive.link}"
            if receive.edge is not None and receive.operator in ("sum", "mean")
            else f"a {receive.operator} can't be taken apart into one number a peer"
        )
        yield f"costs N²: {name} is evaluated once a pair of peers, as {why}"


def analysis_text(result: Analysis) -> Lines:
    """Yield the output of `apc analyze`: the verdict in words, the numbers, the modes as a table."""
    words = _WORDS.get(result.verdict, "The spectral radius lies nearer to 1 than its error bound.")
    named = (("translation", result.translations), ("rotation", result.rotations))
    free = " and ".join(counted(count, noun) for noun, count in named if count)
    if result.translations + result.rotations > 1 and result.verdict.up_to_rigid_modes:
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
    yield from wrapped(
        f"{result.topology}: {result.verdict}{LINEARIZED if result.linearized else ''}", "", "  "
    )
    yield from notes(*result.limitations)
    yield ""
    yield from sentences(*words.splitlines())
    yield ""
    radius = radius_text(result.spectral_radius, result.spectral_radius_error, result.radius_excess)
    unobservable = (
        f"{listed(result.unobservable, MOST_UNOBSERVABLE)}, which nothing that moves reads at these values"
    )
    yield from labelled(
        ("spectral radius", f"{radius} per frame of {quantity(result.frame_s, 's')}"),
        ("peers", f"{result.peers}, {result.states_per_peer} states each"),
        ("method", result.method + (f", {free} left out" if free else "")),
        ("proof", str(result.proof)),
        ("left out", unobservable if result.unobservable else ""),
    )
    yield ""
    yield from _side_table(result)
    yield from _mode_table(result.modes)
    yield from notes(*result.notes)


def _side_table(result: Analysis) -> Lines:
    """Yield the verdict of each side of the kinks at which peers start."""
    if not result.sides:
        return
    rows = [("spectral radius", "verdict", "side of the kink")]
    for side in result.sides:
        error = max(side.spectral_radius_error, SHOWN if abs(side.spectral_radius - 1) > NEAR else 0.0)
        rows.append((radius_text(side.spectral_radius, error, None), side.verdict, side.name))
    yield from table(rows, "<<<")
    yield ""


def analysis_document(result: Analysis) -> Plain:
    """Return the `apc analyze --json` data of the analysis itself."""
    return record(result, {"modes": [_mode_document(mode) for mode in result.modes]})


def _mode_document(mode: Mode) -> Plain:
    (motion,) = mode.motion
    moved = record(motion, {"participation": dict(motion.participation)})
    return record(mode, {"motion": ..., **moved})


def answer_text(answer: AnalysisReport) -> Lines:
    """Yield the output of `apc analyze`: the analysis and its additional results."""
    event_order, topology = answer.event_order, answer.analysis.topology
    warned = f"Warning: {event_order.warning}" if event_order.warning else ""
    nominal: tuple[object, ...] = (answer.analysis, answer.sensitivities, answer.margins)
    if answer.network is not None and not answer.nominal:
        nominal = (_in_short(answer.analysis),)
    parts = (
        answer.box,
        answer.network,
        *nominal,
        answer.contact_modes,
        answer.arbitrary_switching,
        answer.limit_cycle,
        "\n".join(wrapped(f"{topology}: {answer.no_limit_cycle}")) if answer.no_limit_cycle else "",
        event_order if answer.detailed else "\n".join(wrapped(warned)),
    )
    first, _, rest = "\n\n".join(filter(None, map(str, filter(None, parts)))).partition("\n")
    yield first
    yield from warning_lines(answer.warnings)
    yield rest


def _in_short(analysis: Analysis) -> str:
    """Return the verdict of the nominal network, next to that of the lossy network."""
    radius = radius_text(analysis.spectral_radius, analysis.spectral_radius_error, analysis.radius_excess)
    text = (
        f"With every packet on time: {analysis.verdict}, spectral radius {radius} per frame of "
        f"{analysis.frame_s * 1000:.6g} ms (apc analyze --nominal says all of it)."
    )
    return "\n".join(sentences(text))


def warning_lines(warnings: Sequence[str]) -> Lines:
    """Yield the warnings of a topology as indented lines."""
    return notes(*(f"Warning: {text}" for text in warnings))


def network_answer_text(network_answer: NetworkAnswer) -> Lines:
    """Yield the verdict over the lossy network, and its sensitivities."""
    yield f"{network_answer.verdict}\n\n{network_answer.sensitivities}\n\n{network_answer.margins}"


def network_answer_document(network_answer: NetworkAnswer) -> Plain:
    """Return the verdict over the lossy network, and its sensitivities, as plain data."""
    return network_answer.verdict.to_dict() | {
        "sensitivities": network_answer.sensitivities.to_dict(),
        "margins": document(network_answer.margins.rows),
        "margins_note": network_answer.margins.note,
    }


def answer_document(answer: AnalysisReport) -> Plain:
    """Return the `apc analyze --json` data: the analysis with additional keys."""
    plain = answer.analysis.to_dict()
    plain |= picked(answer, "network", "sensitivities", "contact_modes", "arbitrary_switching", "limit_cycle")
    plain |= {
        "margins": document(answer.margins.rows),
        "margins_note": answer.margins.note,
        "limit_cycle_note": "" if answer.limit_cycle else answer.no_limit_cycle or NOT_SIMULATED,
        "warnings": [*answer.warnings, *filter(None, (answer.event_order.warning,))],
    }
    if answer.detailed:
        plain["event_order"] = answer.event_order.to_dict()
    if answer.box is not None:
        plain["box"] = answer.box.to_dict()
    return plain


def _mode_table(modes: Sequence[Mode]) -> Lines:
    """Yield a table of the slowest modes, and a count of the other modes."""
    # Modes indistinguishable from zero are only counted: their rounding depends on the machine.
    alive = [mode for mode in modes if _is_alive(mode)]
    rows = [mode for mode in alive if mode.eigenvalue.imag >= -mode.error]  # a conjugate pair is one row
    shown = rows[:MOST_ROWS]
    dead = [mode for mode in modes if not _is_alive(mode)]
    left = len(dead) + len(rows) - len(shown)
    # A mode indistinguishable from zero may have any size up to its error.
    least = max(shown[-1].magnitude if shown else 0.0, 2 * LEAST_MAGNITUDE)
    unsure = sum(not mode.magnitude + mode.error <= least for mode in dead)
    if shown:
        yield from table([HEADINGS, *map(_cells, shown)], "><>>><")
    if unsure:
        many = "all" if unsure == left > 1 else str(unsure)
        ends = "it dies" if unsure == 1 else "they die"
        text = f"{counted(left, 'mode')} {'more' if shown else ''} (--json lists all),"
        text += f" {many} of them known too roughly to say how fast {ends}"
    elif shown:
        text = f"{left} faster-dying {'one' if left == 1 else 'ones'} (--json lists all)"
    else:
        text = (
            f"{counted(left, 'mode')} {'dies' if left == 1 else 'die'} out within a frame (--json lists all)"
        )
    if left:
        yield from notes(f"and {text}" if shown else text)
    elif not shown:
        yield "  nothing moves but that"


def _is_alive(mode: Mode) -> bool:
    """Return whether a mode is distinguishable from zero."""
    return mode.magnitude > max(mode.error, LEAST_MAGNITUDE)


def _cells(mode: Mode) -> tuple[str, ...]:
    return (
        _magnitude(mode),
        mode.family,
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


def model_size_text(model_size: ModelSize) -> Lines:
    """Yield the size of a model in one sentence."""
    several = len(model_size.subsystems) > 1
    subsystems = "; ".join(
        f"{subsystem.name}: {_subsystem(subsystem)}" if several else _subsystem(subsystem)
        for subsystem in model_size.subsystems
    )
    whole = model_size.peers > 1 and sum(count for count, _ in model_size.systems) == 1
    noun = "determinant" if model_size.method == "determinant" else "system" if whole else "mode"
    systems = " and ".join(f"{counted(count, noun)} of {size}" for count, size in model_size.systems)
    analysed = f"not analysed: {model_size.refused}" if model_size.refused else f"analysed as {systems}"
    pairs = "".join(f"; costs N²: {name} is evaluated once a pair of peers" for name in model_size.pairs)
    yield f"{subsystems}, {counted(model_size.peers, 'peer')}; {analysed}{pairs}"


def _subsystem(subsystem_sizes: SubsystemSize) -> str:
    parts = [f"{subsystem_sizes.motion} motion"]
    if subsystem_sizes.stored:
        parts.append(f"{subsystem_sizes.stored} delayed force")
    if subsystem_sizes.packets:
        parts.append(f"{subsystem_sizes.packets} network")
    return f"{subsystem_sizes.states} states a peer ({', '.join(parts)})"


def box_proof_text(box_proof: RobustStability) -> Lines:
    """Yield the proof over a box."""
    where = [
        f"  {interval.free.label} = {quantity(value, interval.unit, 12)}"
        for interval, value in zip(
            box_proof.ranges, box_proof.counterexample, strict=False
        )  # a proved box has no point
    ]
    cells = counted(box_proof.cells, "cell")
    printed = f"undecided, {100 * box_proof.undecided_fraction:.3g} % of the box is left open ({cells})"
    if box_proof.stable is not None:
        whole = f"proved {box_proof.verdict} for every value in the box ({cells})"
        printed = whole if box_proof.stable else "not stable in all of the box"
    yield f"{box_proof.topology}:"
    for text in (*box_proof.limitations, printed):
        yield from wrapped(text)
    yield from (f"  {range_text(interval)}" for interval in box_proof.ranges)
    if box_proof.stable is False:
        yield f"proved {box_proof.verdict} at"
        yield from where
    elif (
        box_proof.stable is None and box_proof.counterexample
    ):  # otherwise there was no search, as its notes explain
        yield "among others around"
        yield from where
        yield from wrapped(f"more cells may decide it: --cells {MORE_CELLS * box_proof.cells}")
    if box_proof.changing is not None:
        yield ""
        yield from wrapped(changing_text(box_proof.changing, box_proof.ranges[0]))
    yield from notes(*box_proof.notes)


def changing_text(changing: ChangingDelay, over: Range) -> str:
    """Return the result for a time-varying delay, in a sentence."""
    low, high = (quantity(float(number), over.unit, 9) for number in (over.low, over.high))
    printed = [changing.note or "open whether it stays stable"]
    if changing.unstable is not None:
        first, second = changing.unstable
        printed = [f"unstable if by turns {first} packets take {low} and {second} {high}"]
    if changing.proved_to == float(over.high):
        printed = ["stable, proved by the small gain theorem"]
    elif changing.proved_to is not None:
        to = quantity(changing.proved_to, over.unit, 9)
        printed = [
            f"stable from {low} to {to}, proved by the small gain theorem",
            f"over all of it {printed[0]}",
        ]
    return f"However the delay changes from packet to packet: {'; '.join(printed)}."


def range_text(interval: Range) -> str:
    """Return a parameter and its range in words."""
    low, high = (quantity(float(number), interval.unit, 9) for number in (interval.low, interval.high))
    return f"{interval.free.label} from {low} to {high}"


def range_document(interval: Range) -> Plain:
    """Return a parameter and its range as plain data."""
    return {
        "parameter": interval.free.label,
        "unit": interval.unit,
        "range": document((interval.low, interval.high)),
    }


def box_proof_document(box_proof: RobustStability) -> Plain:
    """Return the proof over a box as plain data."""
    return {
        **picked(
            box_proof, "topology", "limitations", "verdict", "stable", "cells", "undecided_fraction", "notes"
        ),
        "box": [range_document(interval) for interval in box_proof.ranges],
        "counterexample": list(box_proof.counterexample) if box_proof.stable is False else None,
        "undecided_around": list(box_proof.counterexample)
        if box_proof.stable is None and box_proof.counterexample
        else None,
        "changing": box_proof.changing and picked(box_proof.changing, "proved_to", "unstable", "note"),
    }


def contact_modes_text(contact_modes: ContactModes) -> Lines:
    """Yield the modes of contact as a table, and which is unstable in words."""
    if not contact_modes.modes:
        yield f"{contact_modes.topology}: no part switches"
        yield from contact_modes.notes
        return
    yield from wrapped(f"{contact_modes.topology}: {contact_modes.summary}")
    yield ""
    yield from (f"  {name} on: it follows the motion; off: it does not" for name in contact_modes.parts)
    rows = [("spectral radius", "frequency", "verdict", "")]
    refused = []
    for mode in contact_modes.modes:
        if mode.refusal:
            rows.append(("–", "–", "not analysed", mode.name))
            refused.append(f"{mode.name}: not analysed: {mode.refusal}")
            continue
        error = max(mode.spectral_radius_error, SHOWN if abs(mode.spectral_radius - 1) > NEAR else 0.0)
        radius = radius_text(mode.spectral_radius, error, mode.radius_excess)
        frequency = in_hertz(mode.frequency_hz) if mode.frequency_hz else "–"
        assert mode.verdict is not None, "a mode without refusal has a verdict"
        rows.append((radius, frequency, mode.verdict.word + "*" * mode.linearized, mode.name))
    yield ""
    yield from table(rows, "<><<")
    if any(mode.linearized for mode in contact_modes.modes):
        yield "\n  * near the start values: this piece is not linear"
    yield from notes(*refused, *contact_modes.notes)


def contact_modes_document(contact_modes: ContactModes) -> Plain:
    """Return the modes of contact as plain data."""
    modes = [_analysed(mode, {"on": dict(mode.on)}, "frequency_hz") for mode in contact_modes.modes]
    return record(contact_modes, {"unstable": contact_modes.unstable, "modes": modes})


def arbitrary_switching_text(arbitrary_switching: ArbitrarySwitching) -> Lines:
    """Yield the result for arbitrary switching of contacts, in words."""
    reach = arbitrary_switching.reach
    if arbitrary_switching.stable:
        text = "proved stable by the circle criterion"
        if arbitrary_switching.jumps:
            text += (
                f" (as {arbitrary_switching.jumps} jumps where it opens, within bounds: it need not "
                "come to rest)"
            )
    else:
        text = (
            f"{'cannot be proved' if arbitrary_switching.stable is False else 'not decided'}: "
            f"{arbitrary_switching.reason}"
        )
    if reach is not None and math.isfinite(reach):
        times = f"{math.floor(reach * 10**DECIMALS) / 10**DECIMALS:.6g}"
        text += f"; the criterion holds for contacts up to {times} times as stiff"
    elif reach is not None:
        text += "; the criterion holds however stiff the contacts"
    yield from wrapped(
        f"{arbitrary_switching.topology}, contacts that open and close at will: {text}", "", "  "
    )


def arbitrary_switching_document(arbitrary_switching: ArbitrarySwitching) -> Plain:
    """Return the result for arbitrary switching of contacts, as plain data."""
    return {"stable": arbitrary_switching.stable, **record(arbitrary_switching)}


def _analysed(result: ContactMode | Outcome, instead: Plain, *more: str) -> Plain:
    """Return plain data of a result that may be a refusal, without numbers then."""
    if not result.verdict:
        instead |= dict.fromkeys(("verdict", "spectral_radius", "spectral_radius_error", *more))
    return record(result, instead)


def event_order_text(event_order: EventOrder) -> Lines:
    """Yield the result of every event order."""
    from apc.analysis.event_order import (  # loaded where there are outcomes, and else not needed
        DEFAULT,
        ORDERS,
    )

    headline = "the same verdict under every convention"
    if not event_order.repeated:
        headline = event_order.not_repeated
    elif event_order.flips:
        headline = "the verdict depends on the conventions"
    yield f"{event_order.topology}: {headline}\n"
    for number, outcome in enumerate(event_order.outcomes, 1):
        radius = radius_text(outcome.spectral_radius, outcome.spectral_radius_error, outcome.radius_excess)
        yield f"  {number}  {outcome.verdict or 'not analysed'}"
        yield f"     spectral radius {radius}" if outcome.verdict else f"     {outcome.refusal}"
        yield from (f"     {departure}" for departure in outcome.departures or (DEFAULT,))
        if outcome.start:
            yield f"     heard before the first packet: {outcome.start}"
        yield f"     {len(outcome.orders)} of {ORDERS} orders, such as {' < '.join(outcome.orders[0])}"
    if event_order.repeated and not event_order.start_matters:
        yield "\n  What is heard before the first packet can't change the verdict."


def event_order_document(event_order: EventOrder) -> Plain:
    """Return the result of every event order as plain data."""
    outcomes = [_analysed(outcome, {}) for outcome in event_order.outcomes]
    return record(
        event_order, {"flips": event_order.flips, "repeated": event_order.repeated, "outcomes": outcomes}
    )


def paper_method_text(paper_method: PaperMethod) -> Lines:
    """Yield the shapes of the paper's matrices, a line each."""
    yield f"ratio {paper_method.ratio}, frame {paper_method.frame_s * 1e3:.6g} ms"
    for field in fields(paper_method):
        matrix = getattr(paper_method, field.name)
        if hasattr(matrix, "columns"):
            which, mark, of = field.name.partition("_")
            name = "A_cl" if which == "closed" else f"{which.upper()}{mark}{of.replace('d', 'D')}"
            yield f"  {name:<6} {len(matrix.rows):>4} × {len(matrix.columns)}"


def matrix_text(named_matrix: NamedMatrix) -> Lines:
    """Yield the shape of a matrix and the ends of its names."""
    rows, columns = named_matrix.rows, named_matrix.columns
    ends = f": {rows[0]} … {rows[-1]} by {columns[0]} … {columns[-1]}" if named_matrix.values.size else ""
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
    for index, mode in enumerate(modes[:MOST_NAMED]):
        times = f" × {mode.multiplicity}" if mode.multiplicity > 1 else ""
        label = f"{mode.magnitude:.4f}{times}, {in_hertz(mode.frequency_hz)}, {mode.family}"
        _mark(ax, mode.eigenvalue, MARKS[index % len(MARKS)], COLOURS[1 + index], label)
    _mark(ax, rest, ".", "0.4", f"{len(rest)} that die out faster")
    seconds = result.settling_s
    settles = "" if seconds is None else f"; settles within 2 % in {seconds:.3g} s"
    radius = f"spectral radius {result.spectral_radius:.6g} per frame of {1e3 * result.frame_s:g} ms{settles}"
    _entitle(ax, [f"{result.topology}: {result.verdict}", radius])
    return ax


def locus_picture(locus: Locus, ax: Any = None) -> Any:
    """Draw where eigenvalues go as a parameter grows; return the matplotlib Axes.

    Parameters
    ----------
    locus
        The eigenvalues by value.
    ax
        The matplotlib Axes to draw into; one of a figure of its own if not given.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    ax = _circle(ax)
    of = locus.critical
    points = np.concatenate(locus.eigenvalues)  # conjugates are among them
    colours = np.repeat(locus.values, [len(eigenvalue) for eigenvalue in locus.eigenvalues])
    plotted = ax.scatter(points.real, points.imag, c=colours, s=5, linewidths=0, cmap="viridis", zorder=3)
    ax.figure.colorbar(plotted, ax=ax, label=axis_label(of.parameter, of.unit))
    _mark(ax, locus.now, "x", COLOURS[2], f"now, {quantity(of.current, of.unit)}")
    for index, crossing in enumerate(of.crossings[:MOST_NAMED]):
        if not locus.values.size or not locus.values[0] <= crossing.value <= locus.values[-1]:
            continue
        nearest = locus.eigenvalues[int(np.abs(locus.values - crossing.value).argmin())]
        at = nearest[np.abs(np.abs(nearest) - 1).argmin()]
        text = "" if np.isnan(crossing.frequency_hz) else f", {in_hertz(crossing.frequency_hz)}"
        label = f"changes at {quantity(crossing.value, of.unit)}{text}"
        _mark(ax, at / abs(at), MARKS[index], "none", label)
    _entitle(ax, [f"{of.topology}: eigenvalues of a frame of {1e3 * locus.frame_s:g} ms, packets on time"])
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
    style = {"markerfacecolor": colour, "markeredgecolor": "0.1" if colour == "none" else colour}
    size = {".": 4, "x": 7}.get(mark, 9 if colour == "none" else 6)
    ax.plot(points.real, points.imag, mark, markersize=size, label=label, zorder=4, **style)


def _entitle(ax: Any, lines: Sequence[str]) -> None:
    ax.autoscale_view()
    ax.set_title("\n".join(text for line in lines for text in textwrap.wrap(line, LETTERS)), fontsize=9)
    legend_below(ax)
