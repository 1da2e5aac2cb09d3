"""Analyses as text, plain data and pictures: verdict, additional results, model size.

Takes: results of `analysis`, and the `AnalysisReport` they make together; a `Locus`.
Gives: their texts and documents; `compile_text`; `analysis_picture`, the eigenvalues over the unit circle,
and `locus_picture`, where they go; `warning_lines`, `changing_text`, `range_text`, `range_document`;
`refusable_record`.
Guarantees: every number that a verdict depends on has its error bound. A picture shows the unit circle, every
eigenvalue and the critical ones. No text covers a mark, and the legend is outside the circle.
Does not: compute, or need a display.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.wording import counted, in_hertz, wrapped
from apc.output.formatting import (
    NEAR,
    Lines,
    Plain,
    axis_label,
    document,
    headed,
    labelled,
    listed,
    notes,
    picked,
    point_text,
    quantity,
    radius_text,
    record,
    sentences,
    table,
)
from apc.output.margins_output import margins_lines, sensitivities_lines
from apc.output.operating_point_output import rest_lines
from apc.output.pictures import COLOURS, legend_below, new_figure, notes_below
from apc.support.optional import need
from apc.verdict import StabilityVerdict

if TYPE_CHECKING:
    from apc.analysis.analysis import Analysis
    from apc.analysis.box_result import ChangingDelay, RobustStability
    from apc.analysis.contact_modes import ContactModes
    from apc.analysis.model_size import ModelSize, SubsystemSize
    from apc.analysis_report import AnalysisReport, NetworkAnswer
    from apc.compiler.compiled import Model
    from apc.parameter_values.parameter_names import Range
    from apc.spectrum.spectrum import Mode
    from apc.studies.root_locus import Locus

MOST_ROWS = 5
PACKETS = 2 / 3  # participation of packets in transit from which a mode is a transport-delay mode
MORE_CELLS = 10  # times as many as left a box open, to try next
DECIMALS = 6  # of a magnitude
MOST_UNOBSERVABLE = 4  # names of excluded modes other than translations
LEAST_MAGNITUDE = 1e-6  # its six digits would show as zero
LARGE = 1e4  # a larger magnitude needs another notation to fit its column
LEAST_SHARE = 0.005  # shows as zero
PAST = "(-"  # in the name of a state that is a past value, such as x(-1 ms)
HEADINGS = ("|eigenvalue|", "type", "f [Hz]", "damping", "participation [%]")
MODES = "Modes (slowest first; a conjugate pair is one row)"
MULTIPLE = "Modes (slowest first; × n: multiplicity; a conjugate pair is one row)"

NOT_SIMULATED = "not predicted: --limit-cycle"
SHOWN = 1e-9  # digits of a contact mode's spectral radius that its column has room for

_WORDS = {
    StabilityVerdict.STABLE: "All motions decay.",
    StabilityVerdict.STABLE_TRANSLATING: (
        "All motions decay except one: no element connects the peers to the ground, so a common translation "
        "of all peers produces no force."
    ),
    StabilityVerdict.STABLE_TURNING: (
        "All motions decay except one: no element restrains the angles of the peers, so a common rotation of "
        "all peers produces no torque."
    ),
    StabilityVerdict.DRIFTS: (
        "All motions decay except common motions with a constant velocity, which no element damps or "
        "restrains."
    ),
    StabilityVerdict.UNSTABLE: "At least one mode grows, until devices oscillate or reach their limits.",
}

SIZE = (5.6, 4.6)  # inches
MOST_NAMED = 5  # modes
MARKS = "os^Dv"
LETTERS = 75  # of a line of a title


def compile_text(model: Model, model_size: ModelSize, target: Path) -> Lines:
    """Yield the output of `apc compile`.

    Parameters
    ----------
    model, model_size
        The model and what it keeps.
    target
        The file written.
    """
    ticks = " = ".join(f"{counted(count, f'{name} period')}" for name, count in model_size.ticks)
    yield f"{model.name} → {target}"
    yield from notes(str(replace(model_size, pairs=())))  # they follow, with their reason
    frame = f"frame {quantity(float(model_size.frame), 's')}"
    yield from notes(f"{frame} = {ticks}" if ticks else f"{frame} (no clock is used)")
    yield from warning_lines(model.warnings)
    dropped = (f"omitted: {name}, as {reason}" for name, reason in model.dropped)
    yield from notes(*_pairwise(model), *dropped)


def _pairwise(model: Model) -> Iterator[str]:
    """Yield the pairwise evaluations, and the reasons why they are not per peer."""
    result = {
        receive.name: receive
        for peer_type in model.peer_types
        for clock in peer_type.clocks
        for receive in clock.receives
        if receive.edge is not None or receive.operator in ("max", "min")
    }
    for name, receive in result.items():
        why = (
            f"its argument is not linear in the values received over {receive.link}"
            if receive.edge is not None and receive.operator in ("sum", "mean")
            else f"a {receive.operator} has no decomposition into one number for each peer"
        )
        yield f"quadratic cost: {name} is evaluated for each pair of peers, as {why}"


def analysis_text(result: Analysis) -> Lines:
    """Yield the output of `apc analyze` without further results: verdict, summary, modes."""
    yield from _summary(result)
    yield from headed(_modes_title(result.modes), _mode_table(result.modes))
    if result.notes:
        yield ""
        yield from notes(*result.notes)


def _summary(result: Analysis, warnings: Sequence[str] = ()) -> Lines:
    """Yield the verdict of an analysis as a sentence, and its numbers.

    Parameters
    ----------
    result
        The analysis.
    warnings
        Those of the topology, printed below the verdict.
    """
    from apc.analysis.analysis import SETTLED  # a result has loaded it

    words = _WORDS.get(result.verdict, "The spectral radius is closer to 1 than its error bound.")
    named = (("translation", result.translations), ("rotation", result.rotations))
    neutral_text = " and ".join(counted(count, noun) for noun, count in named if count)
    excluded = neutral_text if result.rigid_modes > 1 else neutral_text.removeprefix("1 ")
    if result.translations + result.rotations > 1 and result.verdict.up_to_rigid_modes:
        words = f"All motions decay except {neutral_text} of all or some peers, which no element restrains."
    if result.linearized:
        words = f"To first order, {words[0].lower()}{words[1:]}"
    if result.linearized and result.stable is not True:
        words += " For the motion over time, run: apc simulate"
    if not result.states_per_peer:
        words = "The topology has no free motion."
    at_equilibrium = result.equilibrium is not None
    yield from wrapped(
        f"{result.topology}: {result.verdict}{point_text(result.linearized, at_equilibrium)}", "", "  "
    )
    yield from warning_lines(warnings)
    yield from notes(*result.limitations)
    yield ""
    yield from sentences(words)
    yield ""
    radius = radius_text(result.spectral_radius, result.spectral_radius_error, result.radius_excess)
    unobservable = f"{listed(result.unobservable, MOST_UNOBSERVABLE)}: not used by any motion at these values"
    states = (
        f"{result.states_per_peer} states each" if result.peers > 1 else f"{result.states_per_peer} states"
    )
    rows = [("spectral radius", f"{radius} per frame of {quantity(result.frame_s, 's')} (stable < 1)")]
    if result.modes and _is_alive(dominant := result.modes[0]):
        known = not math.isnan(dominant.frequency_hz)
        turns = in_hertz(dominant.frequency_hz) if known else "frequency undetermined"
        turns = turns if dominant.frequency_hz else "real eigenvalue"
        damped = dominant.frequency_hz and not math.isnan(dominant.damping_ratio)
        ratio = f", damping ratio {dominant.damping_ratio:.3g}" if damped else ""
        rows.append(("dominant mode", f"{dominant.family}, {turns}{ratio}"))
    if result.settling_s:
        rows.append(("settling time", f"{quantity(result.settling_s, 's', 3)} (to {100 * SETTLED:g} %)"))
    yield from labelled(
        *rows,
        (
            "excluded",
            f"{counted(result.rigid_modes, 'rigid-body mode')} ({excluded})" if neutral_text else "",
        ),
        ("unobservable", unobservable if result.unobservable else ""),
        ("model", f"{counted(result.peers, 'peer')}, {states}; method: {result.method}"),
        ("proof", str(result.proof)),
    )
    if result.sides:
        point = "equilibrium" if at_equilibrium else "initial state"
        yield from headed(f"Sides of the kinks at the {point}", _side_table(result))
    yield from _equilibrium_lines(result)


def _equilibrium_lines(result: Analysis) -> Lines:
    """Yield the equilibrium at which an analysis is linearized, if any."""
    if result.equilibrium is not None:
        yield from headed("Equilibrium", rest_lines(result.equilibrium))


def _side_table(result: Analysis) -> Lines:
    """Yield the verdict of each side of the kinks at which peers start."""
    rows = [("spectral radius", "verdict", "side of the kink")]
    for side in result.sides:
        error = max(side.spectral_radius_error, SHOWN if abs(side.spectral_radius - 1) > NEAR else 0.0)
        rows.append((radius_text(side.spectral_radius, error, None), side.verdict, side.name))
    yield from table(rows, "<<<")


def analysis_document(result: Analysis) -> Plain:
    """Return the `apc analyze --json` data of the analysis itself."""
    return record(result, {"modes": [_mode_document(mode) for mode in result.modes]})


def _mode_document(mode: Mode) -> Plain:
    (motion,) = mode.motion
    moved = record(motion, {"participation": dict(motion.participation)})
    return record(mode, {"motion": ..., **moved})


def answer_text(answer: AnalysisReport) -> Lines:
    """Yield the output of `apc analyze`: verdict, summary, margins, sensitivities, modes, other results."""
    analysis = answer.analysis
    order = f"Warning: {answer.order_warning}" if answer.order_warning else ""
    warnings = answer.warnings
    if answer.box is not None:
        yield str(answer.box)
        yield from warning_lines(warnings)
        yield ""
        warnings = ()
    if answer.network is not None:
        yield from network_answer_lines(answer.network, warnings)
        warnings = ()
        yield ""
    if answer.network is not None and not answer.nominal:
        yield from _in_short(analysis)
        yield from _equilibrium_lines(analysis)
    else:
        yield from _summary(analysis, warnings)
        yield from margins_lines(answer.margins)
        yield from sensitivities_lines(answer.sensitivities)
        title = _modes_title(analysis.modes)
        yield from headed(title, _mode_table(analysis.modes, everything=answer.all_modes))
    for part in (answer.contact_modes, answer.arbitrary_switching, answer.limit_cycle):
        if part is not None:
            yield f"\n{part}"
    if answer.no_limit_cycle:
        yield from ("", *wrapped(f"Limit cycle: {answer.no_limit_cycle}"))
    if answer.event_order is not None:
        yield f"\n{answer.event_order}"
    texts = (*(() if answer.network is not None and not answer.nominal else analysis.notes), order)
    if any(texts):
        yield ""
        yield from notes(*texts)


def _in_short(analysis: Analysis) -> Lines:
    """Yield the verdict of the nominal network in a sentence."""
    radius = radius_text(analysis.spectral_radius, analysis.spectral_radius_error, analysis.radius_excess)
    text = (
        f"Nominal network (no loss or jitter): {analysis.verdict}, spectral radius {radius} per frame of "
        f"{analysis.frame_s * 1000:.6g} ms. All nominal results: apc analyze --nominal."
    )
    yield from wrapped(text)


def warning_lines(warnings: Sequence[str]) -> Lines:
    """Yield the warnings of a topology as indented lines."""
    return notes(*(f"Warning: {text}" for text in warnings))


def network_answer_text(network_answer: NetworkAnswer) -> Lines:
    """Yield the verdict over the lossy network, its margins and sensitivities."""
    return network_answer_lines(network_answer)


def network_answer_lines(network_answer: NetworkAnswer, warnings: Sequence[str] = ()) -> Lines:
    """Yield the verdict over the lossy network, its margins and sensitivities.

    Parameters
    ----------
    network_answer
        The verdict with its margins and sensitivities.
    warnings
        Those of the topology, printed below the verdict.
    """
    first, *rest = str(network_answer.verdict).splitlines()
    yield first
    yield from warning_lines(warnings)
    yield from rest
    yield from margins_lines(network_answer.margins)
    yield from sensitivities_lines(network_answer.sensitivities, radius="second-moment growth")


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
        "warnings": [*answer.warnings, *filter(None, (answer.order_warning,))],
    }
    if answer.event_order is not None:
        plain["event_order"] = answer.event_order.to_dict()
    if answer.box is not None:
        plain["box"] = answer.box.to_dict()
    return plain


def _modes_title(modes: Sequence[Mode]) -> str:
    """Return the title of the table of modes, which explains multiplicities if there are any."""
    return MULTIPLE if any(mode.multiplicity > 1 for mode in modes) else MODES


def _mode_table(modes: Sequence[Mode], *, everything: bool = False) -> Lines:
    """Yield a table of the slowest modes, the transport-delay modes on one line, and a count of the others.

    Parameters
    ----------
    modes
        All modes, the slowest first.
    everything
        Whether every mode has a row.
    """
    # Modes indistinguishable from zero are only counted: their rounding depends on the machine.
    alive = [mode for mode in modes if everything or _is_alive(mode)]
    pairs = [mode for mode in alive if mode.eigenvalue.imag >= -mode.error]  # a conjugate pair is one row
    folded = [
        bool(number) and not everything and mode.in_transit > PACKETS for number, mode in enumerate(pairs)
    ]
    delays = list(itertools.compress(pairs, folded))
    rows = [mode for mode, hidden in zip(pairs, folded, strict=True) if not hidden]
    shown = rows if everything else rows[:MOST_ROWS]
    dead = [] if everything else [mode for mode in modes if not _is_alive(mode)]
    left = len(dead) + len(rows) - len(shown)
    # A mode indistinguishable from zero may have any size up to its error.
    least = max(shown[-1].magnitude if shown else 0.0, 2 * LEAST_MAGNITUDE)
    unsure = sum(not mode.magnitude + mode.error <= least for mode in dead)
    if shown:
        yield from table([HEADINGS, *map(_cells, shown)], "><>><")
        if any(PAST in _leading(mode) for mode in shown):
            yield from notes("(-T): value at T before the frame; sent(-T): value sent at that time")
    if delays:
        size = f"|eigenvalue| {delays[-1].magnitude:.3g} to {delays[0].magnitude:.3g}"
        yield from notes(f"{counted(len(delays), 'transport-delay mode')} (packets in transit), {size}")
    if left:
        more = "faster " * bool(shown)
        text = f"{left} {more}mode{'s' * (left != 1)} not shown (--modes all)"
        if unsure:
            text += f"; {unsure} of them with an eigenvalue known only up to its error"
        yield from notes(text)
    elif not shown:
        yield "  none"


def _is_alive(mode: Mode) -> bool:
    """Return whether a mode is distinguishable from zero."""
    return mode.magnitude > max(mode.error, LEAST_MAGNITUDE)


def _cells(mode: Mode) -> tuple[str, ...]:
    """Return the cells of a mode's row, in the order of `HEADINGS`."""
    return (
        _magnitude(mode),
        mode.family + (f" × {mode.multiplicity:,}" if mode.multiplicity > 1 else ""),
        in_hertz(mode.frequency_hz).removesuffix(" Hz") if mode.frequency_hz else "real",
        "–" if math.isnan(mode.damping_ratio) or not mode.frequency_hz else f"{mode.damping_ratio + 0.0:.3g}",
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
    name, share = max(mode.participation, key=lambda item: item[1], default=("", 0.0))
    return f"{name} {100 * share:.0f}" if share >= LEAST_SHARE else ""


def model_size_text(model_size: ModelSize) -> Lines:
    """Yield the size of a model in one sentence."""
    several = len(model_size.subsystems) > 1
    subsystems = "; ".join(
        f"{subsystem.name}: {_subsystem(subsystem)}" if several else _subsystem(subsystem)
        for subsystem in model_size.subsystems
    )
    whole = model_size.peers > 1 and sum(count for count, _ in model_size.systems) == 1
    noun = "determinant" if model_size.method == "determinant" else "system" if whole else "subsystem"
    systems = " and ".join(
        f"{counted(count, noun)} of {counted(size, 'state')}" for count, size in model_size.systems
    )
    analysed = f"not analyzed: {model_size.refused}" if model_size.refused else f"analyzed as {systems}"
    pairs = "".join(
        f"; quadratic cost: {name} is evaluated for each pair of peers" for name in model_size.pairs
    )
    peers = counted(model_size.peers, "peer")
    sizes = f"{peers}; {subsystems}" if several else f"{subsystems}, {peers}"
    yield f"{sizes}; {analysed}{pairs}"


def _subsystem(subsystem_sizes: SubsystemSize) -> str:
    """Return the number of states of a peer, and of what they are, in words."""
    parts = [f"{subsystem_sizes.motion} motion"]
    if subsystem_sizes.stored:
        parts.append(f"{subsystem_sizes.stored} delayed force")
    if subsystem_sizes.packets:
        parts.append(f"{subsystem_sizes.packets} network")
    return f"{subsystem_sizes.states} states per peer ({', '.join(parts)})"


def box_proof_text(box_proof: RobustStability) -> Lines:
    """Yield the proof over a box."""
    where = [
        f"  {interval.free.label} = {quantity(value, interval.unit, 12)}"
        for interval, value in zip(
            box_proof.ranges, box_proof.counterexample, strict=False
        )  # a proved box has no point
    ]
    cells = counted(box_proof.cells, "cell")
    printed = f"undecided in {100 * box_proof.undecided_fraction:.3g} % of the box ({cells})"
    if box_proof.stable is not None:
        whole = f"proved {box_proof.verdict} for every value in the box ({cells})"
        printed = whole if box_proof.stable else "not stable in the entire box"
    yield from wrapped(f"{box_proof.topology}: {printed}", "", "  ")
    yield from notes(*box_proof.limitations)
    yield ""
    yield from (f"  {range_text(interval)}" for interval in box_proof.ranges)
    if box_proof.stable is False:
        yield f"  proved {box_proof.verdict} at"
        yield from (f"  {text}" for text in where)
    elif (
        box_proof.stable is None and box_proof.counterexample
    ):  # otherwise there was no search, as its notes explain
        yield "  undecided, among others, near"
        yield from (f"  {text}" for text in where)
        yield from sentences(f"Try more cells: --cells {MORE_CELLS * box_proof.cells}")
    if box_proof.changing is not None:
        yield ""
        yield from sentences(changing_text(box_proof.changing, box_proof.ranges[0]))
    yield from notes(*box_proof.notes)


def changing_text(changing: ChangingDelay, over: Range) -> str:
    """Return the result for a time-varying delay, in a sentence."""
    low, high = (quantity(float(number), over.unit, 9) for number in (over.low, over.high))
    printed = [changing.note or "stability is undecided"]
    if changing.unstable is not None:
        first, second = changing.unstable
        packets = f"{counted(first, 'packet')} with {low} and {counted(second, 'packet')} with {high}"
        printed = [f"unstable if {packets} alternate"]
    if changing.proved_to == float(over.high):
        printed = ["stable, proved by the small gain theorem"]
    elif changing.proved_to is not None:
        to = quantity(changing.proved_to, over.unit, 9)
        printed = [
            f"stable from {low} to {to}, proved by the small gain theorem",
            f"over the entire range {printed[0]}",
        ]
    return f"Delay that varies arbitrarily from packet to packet: {'; '.join(printed)}."


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
        yield f"{contact_modes.topology}: no contact"
        yield from contact_modes.notes
        return
    yield from wrapped(f"Contact modes: {contact_modes.summary}")
    rows = [("spectral radius", "frequency", "verdict", "contacts")]
    refused: dict[str, list[str]] = {}
    for mode in contact_modes.modes:
        if mode.refusal:
            rows.append(("–", "–", "not analyzed", mode.name))
            refused.setdefault(mode.refusal, []).append(mode.name)
            continue
        error = max(mode.spectral_radius_error, SHOWN if abs(mode.spectral_radius - 1) > NEAR else 0.0)
        radius = radius_text(mode.spectral_radius, error, mode.radius_excess)
        frequency = in_hertz(mode.frequency_hz) if mode.frequency_hz else "–"
        assert mode.verdict is not None, "a mode without refusal has a verdict"
        rows.append((radius, frequency, mode.verdict.word + "*" * mode.linearized, mode.name))
    yield ""
    yield from table(rows, "<><<")
    if any(mode.linearized for mode in contact_modes.modes):
        yield "\n  * linearized: this mode is nonlinear"
    reasons = (f"not analyzed: {', '.join(names)}: {why}" for why, names in refused.items())
    yield from notes(*reasons, *contact_modes.notes)


def contact_modes_document(contact_modes: ContactModes) -> Plain:
    """Return the modes of contact as plain data."""
    modes = [refusable_record(mode, {"on": dict(mode.on)}, "frequency_hz") for mode in contact_modes.modes]
    return record(contact_modes, {"unstable": contact_modes.unstable, "modes": modes})


def refusable_record(result: Any, instead: Plain, *more: str) -> Plain:
    """Return plain data of a result that may be a refusal, without numbers then."""
    if not result.verdict:
        instead |= dict.fromkeys(("verdict", "spectral_radius", "spectral_radius_error", *more))
    return record(result, instead)


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
    own, ax = ax is None, _circle(ax)
    modes = [mode for mode in result.modes if mode.eigenvalue.imag >= -mode.error]  # of a pair one
    rest = [mode.eigenvalue for mode in modes[MOST_NAMED:]]
    for index, mode in enumerate(modes[:MOST_NAMED]):
        times = f" × {mode.multiplicity}" if mode.multiplicity > 1 else ""
        turns = in_hertz(mode.frequency_hz) if mode.frequency_hz else "real"
        label = f"{mode.magnitude:.4f}, {turns}, {mode.family}{times}"
        _mark(ax, mode.eigenvalue, MARKS[index % len(MARKS)], COLOURS[1 + index], label)
    _mark(ax, rest, ".", "0.4", f"{len(rest)} faster modes")
    seconds = result.settling_s
    settles = "" if seconds is None else f"; settling time (2 %) {quantity(seconds, 's', 3)}"
    radius = f"spectral radius {result.spectral_radius:.6g} per frame of {1e3 * result.frame_s:g} ms{settles}"
    _entitle(ax, [f"{result.topology}: {result.verdict}", radius])
    if own:
        notes_below(ax.figure, [str(note) for note in result.limitations])
    return ax


def locus_picture(locus: Locus, ax: Any = None) -> Any:
    """Draw the root locus of a parameter; return the matplotlib Axes.

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
    _mark(ax, locus.now, "x", COLOURS[2], f"present value, {quantity(of.current, of.unit)}")
    for index, crossing in enumerate(of.crossings[:MOST_NAMED]):
        if not locus.values.size or not locus.values[0] <= crossing.value <= locus.values[-1]:
            continue
        nearest = locus.eigenvalues[int(np.abs(locus.values - crossing.value).argmin())]
        at = nearest[np.abs(np.abs(nearest) - 1).argmin()]
        text = "" if np.isnan(crossing.frequency_hz) else f", {in_hertz(crossing.frequency_hz)}"
        label = f"stability limit {quantity(crossing.value, of.unit)}{text}"
        _mark(ax, at / abs(at), MARKS[index], "none", label)
    _entitle(ax, [f"{of.topology}: eigenvalues per frame of {1e3 * locus.frame_s:g} ms, nominal network"])
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
