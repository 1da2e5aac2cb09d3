"""Runs and ensembles of runs as text, plain data, tables and pictures.

Takes: results of `simulation`. Gives: their texts, documents, tables and pictures; `provenance_json`.
Guarantees: a text fits 80 columns. In a picture every curve is named, a colour a peer and a dash a part, and
coincident ones are identified. With more than ten peers each group has a color. Labels are next to the panels
and cover nothing.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.language.vectors import entry, whole_and_index
from apc.compiler.wording import counted, measured
from apc.output.formatting import (
    Lines,
    Plain,
    document,
    json_text,
    labelled,
    notes,
    quantity,
    record,
    sentences,
    table,
)
from apc.output.pictures import colours_of, new_figure, prefixed, short_legend
from apc.simulation.motion_classes import MotionVerdict
from apc.simulation.settings import EXACT
from apc.support.optional import need

if TYPE_CHECKING:
    from apc.simulation.accuracy import ErrorEstimate
    from apc.simulation.decay import Fit, Oscillation
    from apc.simulation.monte_carlo import Ensemble, MeanSquare
    from apc.simulation.signals import Signal
    from apc.simulation.trajectory import Provenance, SimulationReport, Trajectory

Floats = NDArray[np.float64]

LABELS = {
    "settled": "settling time [s]",
    "largest_force": "largest force [N]",
    "copy_error": "coordination error [mm]",
}
MILLIMETRES = 1e3
# By unit: the panel's title.
QUANTITIES = {
    "m": "position",
    "m/s": "velocity",
    "N": "force",
    "rad": "angle",
    "rad/s": "angular velocity",
    "N*m": "torque",
}
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (7, 2)), (0, (3, 1, 1, 1, 1, 1)))
MOST_COLOURS = 10  # peers with a colour each; of more each group has one
MOST_CHANGES = 8  # joins and leaves in a text
ROUNDING = 1e-9  # of what a panel spans
LABEL = 36  # letters of a line of a legend
MOST_LIMITS = 4  # printed as text; the document has all
MOST_CURVES = 24  # in a panel: more are not distinguishable
WIDTH, HEIGHT = 9.0, 2.4  # inches: of the figure, of a panel
PATHS = 2.0  # times as high is a plane
_WORDS = {
    MotionVerdict.AT_REST: "No {position} changes.",
    MotionVerdict.DECAYS: "Every {position} converges to a constant value.",
    MotionVerdict.OSCILLATES: "The final oscillation neither decays nor grows.",
    MotionVerdict.DIVERGES: "The motion grows.",
    MotionVerdict.DRIFTS: "A {position} finally moves with constant velocity or acceleration.",
    MotionVerdict.DRIVEN: "A force or another equation depends on time until the end of the run.",
}
OVERFLOW = "{stopped} overflows after {stopped_at}."
LEAST_ERROR = 5e-7  # of a value: more digits than six are in the document
BAND_TEXT = "(5 % of the range, all positions)"


def simulation_text(simulated: SimulationReport) -> Lines:
    """Yield the output of `apc simulate`: the summary, the method if not exact, the error if known."""
    summary = simulated.summary
    units = {extent.name: extent.unit for extent in summary.extents}
    yield f"{simulated.topology}: {summary.verdict}\n"
    words = f"Undetermined after {summary.end:g} s: {summary.reason}."
    if summary.verdict is not MotionVerdict.NOT_DETERMINED:
        words = OVERFLOW if summary.stopped else _WORDS[summary.verdict]
        words = words.format(
            position="recorded position" if summary.unrecorded else "position",
            stopped=summary.stopped,
            stopped_at=_quantity(summary.stopped_at or 0.0, "s"),
        )
    yield from sentences(words)
    yield ""
    for title, text in _facts(simulated, units):
        yield from labelled((title, text))


def _quantity(value: float, unit: str) -> str:
    """Return a number with its unit, thousandths of it where it is small."""
    if value and abs(value) < 0.1 and unit in ("m", "s", "J", "N"):
        return f"{1e3 * value:.3g} m{unit}" if abs(value) >= 1e-4 else f"{1e6 * value:.3g} µ{unit}"
    return quantity(value, unit, 3)


def _method(provenance: Provenance) -> str:
    """Return the method with its tolerances, of each unit the smallest."""
    smallest: dict[str, float] = {}
    for tolerance in provenance.tolerances:
        smallest[tolerance.unit] = min(smallest.get(tolerance.unit, tolerance.absolute), tolerance.absolute)
    absolute = ", ".join(f"{value:.1g} {unit}" for unit, value in smallest.items())
    return provenance.method + (f"; absolute tolerances from {absolute}" if absolute else "")


def error_text(estimate: ErrorEstimate) -> str:
    """Return the text of an error estimate: the worst signal, and the compared method."""
    worst = estimate.largest
    description = "rounding only, about " if estimate.kind == "rounding" else "about "
    if worst is None or not worst.error:
        return f"{description}0 in every signal ({estimate.compared})"
    size = f"{worst.error:.1g} {worst.unit} in {worst.name} at {worst.at:g} s"
    return f"{description}{size}, {worst.relative:.1g} of its range ({estimate.compared})"


def simulation_document(simulated: SimulationReport) -> Plain:
    """Return the output of `apc simulate --json`."""
    summary = simulated.summary
    fit = summary.fit
    crests = fit.oscillation if fit is not None and summary.oscillating else None

    def keyed(values: Sequence[Any] | None, *keys: str) -> Plain | None:
        return None if values is None else dict(zip(keys, values, strict=True))

    return {
        "topology": simulated.topology,
        "verdict": summary.verdict,
        "reason": summary.reason or None,
        "settling_time_s": summary.settled,
        "settling_time_error_s": summary.settled_error,
        "decay": None if fit is None else _decay_document(fit),
        "oscillation": None if crests is None else _oscillation_document(crests, summary.oscillating),
        "driven_until_s": summary.driven_until,
        "diverged": {"signal": summary.stopped, "time_s": summary.stopped_at} if summary.stopped else None,
        "interrupted": simulated.interrupted,
        "overshoot": keyed(summary.overshoot, "signal", "part"),
        "limits_broken": document(summary.broken),
        "largest_force": keyed(summary.largest_force, "signal", "N", "time_s"),
        "copy_error": dict(summary.copies),
        "work_J": dict(summary.work),
        "rows": summary.rows,
        "end_s": summary.end,
        "signals": [
            record(extent, {"settled": ..., "settling_time_s": extent.settled}) for extent in summary.extents
        ],
        "error_estimate": None if simulated.error is None else _error_document(simulated.error),
        "provenance": provenance_document(simulated.provenance),
    }


def _decay_document(fit: Fit) -> Plain:
    """Return the rate of the slowest exponential as plain data, None where it is not known."""
    known = math.isfinite(fit.error)
    return {
        "rate_per_s": fit.rate if known else None,
        "rate_error_per_s": fit.error if known else None,
        "time_constant_s": -1 / fit.rate if fit.decays else None,
        "window_s": fit.span,
    }


def _oscillation_document(crests: Oscillation, name: str) -> Plain:
    """Return the sustained oscillation of a signal as plain data."""
    return {
        "signal": name,
        "peak_to_peak": crests.size,
        "frequency_hz": crests.frequency,
        "frequency_error_hz": crests.error,
    }


def _error_document(error_estimate: ErrorEstimate) -> Plain:
    """Return the error estimate of a simulation as plain data."""
    signals = [
        record(signal, {"at": ..., "span": ..., "time_s": signal.at, "range": signal.span})
        for signal in error_estimate.signals
    ]
    return {"kind": error_estimate.kind, "compared_with": error_estimate.compared, "signals": signals}


def provenance_document(provenance: Provenance) -> Plain:
    """Return the provenance of a result as plain data."""
    instead = {
        "texts": ...,
        "sha256": provenance.texts,
        "tolerances": {
            tolerance.state: record(tolerance, {"state": ...}) for tolerance in provenance.tolerances
        },
        "parameters": {name: {"value": value, "unit": unit} for name, value, unit in provenance.parameters},
        "timings": ...,
        "timings_s": dict(provenance.timings),
        "joins": ...,
        "joins_s": {item.peer: str(item.at) for item in provenance.joins},
        "leaves": ...,
        "leaves_s": {item.peer: str(item.at) for item in provenance.leaves},
        "versions": dict(provenance.versions),
    }
    return record(provenance, instead)


def provenance_json(provenance: Provenance) -> str:
    """Return the provenance of a result as one line of JSON."""
    return json_text(provenance_document(provenance), indent=None)


def simulation_table(trajectory: Trajectory) -> Any:
    """Return the rows of a run as a pandas table."""
    pandas = need("pandas", "data")
    columns = [signal.heading for signal in trajectory.signals]
    return pandas.DataFrame(trajectory.values, pandas.Index(trajectory.time, name="time [s]"), columns)


def simulation_dataset(trajectory: Trajectory) -> Any:
    """Return the rows of a run as an xarray Dataset."""
    xarray = need("xarray", "data")
    variables = {
        signal.name: ("time", trajectory.values[:, index], {"units": signal.unit})
        for index, signal in enumerate(trajectory.signals)
    }
    time = ("time", trajectory.time, {"units": "s"})
    return xarray.Dataset(variables, {"time": time}, {"provenance": provenance_json(trajectory.provenance)})


def simulation_picture(trajectory: Trajectory, ax: Any = None) -> Any:
    """Draw a trajectory, a panel a quantity, or everything into one Axes; return the matplotlib Figure.

    Parameters
    ----------
    trajectory
        The signals to draw.
    ax
        The matplotlib Axes to draw into; the signals must then share one unit.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    panels = _panels(trajectory.signals)
    if ax is not None:
        assert len(panels) == 1, f"one Axes can't show signals in {', '.join(panels)}"
        [(unit, indices)] = panels.items()
        _panel(ax, trajectory, unit, indices)
        ax.set_xlabel("time [s]")
        return ax.figure
    paths = paths_of(trajectory.signals)
    heights = [1.0] * len(panels) + [PATHS] * bool(paths)
    figure = new_figure((WIDTH, HEIGHT * sum(heights) + 0.6))
    axes = figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axis, (unit, indices) in zip(axes, panels.items(), strict=False):
        _panel(axis, trajectory, unit, indices)
        if axis is not axes[0]:
            axis.sharex(axes[0])
        axis.tick_params(labelbottom=axis is axes[len(panels) - 1])
    axes[len(panels) - 1].set_xlabel("time [s]")
    if paths:
        _draw_paths(axes[-1], trajectory, paths)
    figure.suptitle(f"{trajectory.topology}: {trajectory.summary.verdict}", fontsize=11)
    return figure


def _panels(signals: Sequence[Signal]) -> dict[str, list[int]]:
    """Return the signals' places by unit: first the known quantities, then the others as they come."""
    result: dict[str, list[int]] = {}
    for index, signal in enumerate(signals):
        result.setdefault(signal.unit, []).append(index)
    return {unit: result[unit] for unit in dict.fromkeys([*QUANTITIES, *result]) if unit in result}


def paths_of(signals: Sequence[Signal]) -> list[tuple[int, int]]:
    """Return the signals that are the first two coordinates of one position."""
    index_of = {signal.name: index for index, signal in enumerate(signals) if signal.unit == "m"}
    pairs = [
        (index, entry(whole_and_index(name)[0], 2))
        for name, index in index_of.items()
        if name.endswith("[1]")
    ]
    return [(index, index_of[second]) for index, second in pairs if second in index_of]


def _draw_paths(ax: Any, trajectory: Trajectory, paths: Sequence[tuple[int, int]]) -> None:
    """Draw the paths of positions in their plane, each from its start, a dot."""
    signals, values = trajectory.signals, 1e3 * trajectory.values
    for number, two in paths[:MOST_CURVES]:
        colour, dashes = _style(signals, [first for first, _ in paths], number)
        label, _ = whole_and_index(signals[number].name)
        ax.plot(values[:, number], values[:, two], color=colour, linestyle=dashes, linewidth=1.0, label=label)
        ax.plot(values[:1, number], values[:1, two], "o", color=colour, markersize=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x[1] [mm]", ylabel="path: x[2] [mm]")
    _finish(ax, len(paths))


def _panel(ax: Any, trajectory: Trajectory, unit: str, indices: Sequence[int]) -> None:
    """Draw the signals of one unit, the columns `indices` of a trajectory, as curves over time."""
    title = QUANTITIES.get(unit, "")
    largest = float(np.fmax.reduce(np.abs(trajectory.values[:, list(indices)]), axis=None, initial=0.0))
    scale, shown = prefixed(largest, unit)
    signals, values = trajectory.signals, scale * trajectory.values
    many = _are_many(signals)
    curves = _by_group(signals, indices) if many else _identical(values, indices)
    for columns in curves[:MOST_CURVES]:
        signal = signals[columns[0]]
        names = ", ".join(signals[index].name for index in columns)
        label = f"{names}: identical" if len(columns) > 1 else names
        if many:
            label = f"{signal.group}.{signal.local}: {counted(len(columns), 'peer')}"
        colour, dashes = _style(signals, indices, columns[0])
        style = {"color": colour, "linestyle": dashes, "linewidth": 0.4 if many else 1.0}
        first, *_ = ax.plot(trajectory.time, values[:, columns if many else columns[:1]], **style)
        first.set_label("\n".join(textwrap.wrap(label, LABEL)))
    ax.set_ylabel(f"{title} [{shown.replace('*', '·')}]".strip())
    ax.margins(x=0)
    _finish(ax, len(curves))


def _are_many(signals: Sequence[Signal]) -> bool:
    """Return whether there are more peers than distinguishable colors."""
    return len({(signal.group, signal.peer) for signal in signals}) > MOST_COLOURS


def _identical(values: Floats, indices: Sequence[int]) -> list[list[int]]:
    """Return indices grouped by curve: one group differs only by rounding, relative to the panel's range."""
    result: list[list[int]] = []
    off = ROUNDING * float(np.nanmax(values[:, indices]) - np.nanmin(values[:, indices]))
    for index in indices:
        same = (
            numbers
            for numbers in result
            if np.allclose(values[:, index], values[:, numbers[0]], rtol=0, atol=off, equal_nan=True)
        )
        if (curve := next(same, None)) is None:
            result.append(curve := [])
        curve.append(index)
    return result


def _by_group(signals: Sequence[Signal], indices: Sequence[int]) -> list[list[int]]:
    """Return places by group and quantity."""
    members: dict[tuple[str, str], list[int]] = {}
    for index in indices:
        members.setdefault((signals[index].group, signals[index].local), []).append(index)
    return [*members.values()]


def _style(signals: Sequence[Signal], indices: Sequence[int], index: int) -> tuple[Any, Any]:
    """Return a signal's colour, its peer's or where these are many its group's, and its dashes in a panel."""
    many = _are_many(signals)
    owners = list(dict.fromkeys((signal.group, 0 if many else signal.peer) for signal in signals))
    quantities = list(dict.fromkeys(signals[other].local for other in indices))
    signal = signals[index]
    colour = colours_of(len(owners))[owners.index((signal.group, 0 if many else signal.peer))]
    return colour, DASHES[quantities.index(signal.local) % len(DASHES)]


def _finish(ax: Any, curves: int) -> None:
    """Label the first curves at a panel, with the number of the others, drawn or not."""
    ax.grid(linewidth=0.4, alpha=0.5)
    style = {"loc": "center left", "bbox_to_anchor": (1.01, 0.5), "fontsize": 8, "frameon": False}
    handles, labels = ax.get_legend_handles_labels()
    handles, labels = short_legend(handles, labels, curves)
    ax.legend(handles, labels, handlelength=2.6, **style)


def ensemble_text(ensemble: Ensemble) -> Lines:
    """Yield the statistics of an ensemble, in lines of at most 80 columns."""
    from apc.simulation.monte_carlo import share_interval

    n = len(ensemble.runs)
    duration = f"{float(ensemble.duration):g} s, seed {ensemble.seed}"
    yield f"{ensemble.topology[:40]}: {counted(n, 'run')} of {duration}"
    shares = []
    for verdict, count in ensemble.verdicts:
        low, high = share_interval(count, n)
        text = f"{100 * count / n:.3g} % (95 % interval: {100 * low:.3g} % to {100 * high:.3g} %)"
        shares.append((verdict, str(count), text))
    yield from table(shares, "<><")
    yield ""
    rows: list[tuple[str, ...]] = [("", "mean", "± error", "5 %", "median", "95 %", "most")]
    for name, label in LABELS.items():
        statistics = ensemble.statistics(name)
        if statistics is not None:
            scale = MILLIMETRES if name == "copy_error" else 1.0
            error = f"± {scale * statistics.standard_error:.1g}" if statistics.count > 1 else ""
            values = (f"{scale * value:.3g}" for value in (*statistics.quantiles, statistics.high))
            rows.append((label, f"{scale * statistics.mean:.3g}", error, *values))
    yield from table(rows, "<>>>>>>")
    settled = ensemble.statistics("settled")
    if settled is not None and settled.count < n:
        yield f"  The settling time is that of the {counted(settled.count, 'run')} that settle."
    if ensemble.mean_square is not None:
        yield from notes(_side_by_side(ensemble, ensemble.mean_square))
    if ensemble.interrupted:
        yield "  Interrupted: more runs were requested."


def _side_by_side(ensemble: Ensemble, mean_square: MeanSquare) -> str:
    """Return one sentence on the agreement of the runs with the mean-square verdict."""
    n, calm = len(ensemble.runs), ensemble.calm
    if mean_square.why:
        return f"The mean-square verdict is not available: {mean_square.why}."
    text = f"Verdict: {mean_square.verdict}; {calm} of {counted(n, 'run')} decay or are at rest."
    if mean_square.linearized:
        return f"{text} The verdict holds for small motions about the start; the runs include open contacts."
    if mean_square.stable is None:
        return f"{text} The error bounds contain 1, so the verdict is undecided."
    if ensemble.agrees:
        return f"{text} The runs agree with the verdict."
    if not mean_square.stable:
        return f"{text} The growth of second moments is rarer or slower than these runs can show."
    if mean_square.settles_in is not None and mean_square.settles_in > ensemble.duration:
        return f"{text} Settling takes about {mean_square.settles_in:.2g} s, longer than the runs."
    return f"{text} A force that does not end drives the others; the verdict does not include it."


def ensemble_document(ensemble: Ensemble) -> Plain:
    """Return the statistics of an ensemble as plain data."""
    from apc.simulation.monte_carlo import QUANTILES, share_interval

    n, mean_square = len(ensemble.runs), ensemble.mean_square
    shares = {
        verdict: {"runs": count, "share": count / n, "share_95": list(share_interval(count, n))}
        for verdict, count in ensemble.verdicts
    }
    instead: Plain = {
        "duration": ...,
        "duration_s": ensemble.duration,
        "runs": n,
        "mean_square": None
        if mean_square is None
        else {
            **document(mean_square),
            "verdict": document(mean_square.verdict or ""),
            "agrees": ensemble.agrees,
        },
        "verdicts": shares,
    }
    for name in LABELS:
        instead[name] = statistics = ensemble.statistics(name)
        if statistics is not None:
            quantiles = dict(zip(map(str, QUANTILES), statistics.quantiles, strict=True))
            instead[name] = record(
                statistics, {"count": ..., "runs": statistics.count, "quantiles": quantiles}
            )
    return record(ensemble, instead)


def _fitted(fit: Fit, name: str, units: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the time constant and the frequency of the last part of a motion, each with its error."""
    if fit.decays or fit.grows:
        constant, off = 1 / abs(fit.rate), fit.error / (abs(fit.rate) * (abs(fit.rate) - fit.error))
        yield "decay" if fit.decays else "growth", f"time constant {_uncertain(constant, off, 's')}"
    elif fit.lasts:
        yield "decay rate", _uncertain(-fit.rate, fit.error, "1/s")
    if fit.oscillation is not None and math.isfinite(fit.error):
        frequency = _uncertain(fit.oscillation.frequency, fit.oscillation.error, "Hz")
        size = _quantity(fit.oscillation.size, units[name])
        yield "frequency", f"{frequency}, {name}, peak to peak {size} at the end"


def _uncertain(value: float, error: float, unit: str) -> str:
    """Return a number with its error, of six digits at most."""
    return measured(value, max(error, LEAST_ERROR * abs(value)), unit)


def _facts(simulated: SimulationReport, units: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the results of a run, each with its label; `units` are those of its signals by name."""
    summary = simulated.summary
    moves = summary.verdict is not MotionVerdict.AT_REST
    if summary.settled is not None:
        description = (
            f" (at most {_quantity(summary.settled_error, 's')} less)" if summary.settled_error else ""
        )
        yield "settling time", f"{_quantity(summary.settled, 's')}{description} {BAND_TEXT}"
    elif summary.verdict in (MotionVerdict.DECAYS, MotionVerdict.OSCILLATES):
        yield "settling time", f"not reached in {summary.end:g} s {BAND_TEXT}"
    if summary.fit is not None and summary.verdict in (
        MotionVerdict.DECAYS,
        MotionVerdict.OSCILLATES,
        MotionVerdict.DIVERGES,
        MotionVerdict.NOT_DETERMINED,
    ):
        yield from _fitted(summary.fit, summary.oscillating, units)
    if summary.largest_force and (summary.largest_force[1] or moves):
        name, size, at = summary.largest_force
        yield "largest force", f"{_quantity(size, 'N')}, {name} at {_quantity(at, 's')}"
    for broken in summary.broken[:MOST_LIMITS]:
        most, beyond = (_quantity(value, broken.unit) for value in (broken.most, broken.most - broken.value))
        when = f"{broken.signal} from {_quantity(broken.first_s, 's')} on: at most {most} at"
        yield "limit exceeded", f"{when} {_quantity(broken.at_s, 's')}, above {broken.limit} by {beyond}"
    if len(summary.broken) > MOST_LIMITS:
        yield "limit exceeded", f"{len(summary.broken) - MOST_LIMITS} more"
    if summary.overshoot:
        name, relative = summary.overshoot
        yield "overshoot", f"{100 * relative:.3g} % of the net displacement, {name}"
    for name, distance in summary.copies:
        if distance or moves:
            unit = next(unit for signal, unit in units.items() if signal.endswith(f".{name}"))
            yield "coordination error", f"{_quantity(distance, unit)} between the copies of {name} at the end"
    if any(value for _, value in summary.work):
        done = ", ".join(f"{part} {_quantity(value, 'J')}" for part, value in summary.work)
        yield "energy generated", f"{done} (by sample-and-hold)"
    provenance = simulated.provenance
    changes = [(item.at, f"{item.peer} joins") for item in provenance.joins]
    changes += [(item.at, f"{item.peer} leaves") for item in provenance.leaves]
    if changes:
        texts = [f"{text} at {_quantity(float(at), 's')}" for at, text in sorted(changes)]
        more = [f"{len(texts) - MOST_CHANGES} more changes"] if len(texts) > MOST_CHANGES else []
        yield "peers", ", ".join(texts[:MOST_CHANGES] + more)
    yield "recorded", f"{summary.rows} samples of {summary.signals} signals until {summary.end:g} s"
    if provenance.method != EXACT:
        yield "method", _method(provenance)
    if simulated.error:
        yield "error", error_text(simulated.error)
