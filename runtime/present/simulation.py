"""Runs and ensembles of runs as text, plain data, tables and pictures.

Takes: results of `simulation`. Gives: their texts, documents, tables and pictures; `provenance_json`.
Guarantees: a text fits 80 columns. In a picture every curve is named, a colour a peer and a dash a part, and
those that are one are said to be; of more than ten peers each group has a colour, and the extremes are named;
labels stand beside the panels, over nothing; a long run is drawn by the extremes of its rows, so that no
swing is lost.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.timings import part
from apc.compiler.words import counted, in_hertz, with_unit, wrapped
from apc.optional import need
from apc.present.forms import document, json_text, note
from apc.present.pictures import check_format, colours_of, write_figure
from apc.present.planar import draw_paths, paths_of
from apc.simulation.settings import EXACT

if TYPE_CHECKING:
    from apc.simulation.accuracy import ErrorEstimate
    from apc.simulation.buzz import Buzz
    from apc.simulation.ensemble import Ensemble, MeanSquare, Statistics
    from apc.simulation.signals import Signal
    from apc.simulation.summary import Broken
    from apc.simulation.trajectory import Played, Provenance, Trajectory

Floats = NDArray[np.float64]

LABELS = {
    "settled": "settled at [s]",
    "largest_force": "largest force [N]",
    "copies_apart": "copies apart [m]",
}
# Unit: what the panel is called, the unit it is drawn in, and how many of them make one of SI.
QUANTITIES = {
    "m": ("position", "mm", 1e3),
    "m/s": ("velocity", "m/s", 1.0),
    "N": ("force", "N", 1.0),
    "rad": ("angle", "rad", 1.0),
    "rad/s": ("angular velocity", "rad/s", 1.0),
    "N*m": ("torque", "N·m", 1.0),
}
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (7, 2)), (0, (3, 1, 1, 1, 1, 1)))
MOST_COLOURS = 10  # peers with a colour each; of more each group has one
ROUNDING = 1e-9  # of what a panel spans
LABEL = 36  # letters of a line of a legend
MOST_LIMITS = 4  # that are told as text; the document has all
MOST_CURVES = 24  # in a panel: more can't be told apart
MOST_POINTS = 2000  # of a curve: about one a pixel and a half of a wide picture
WIDTH, HEIGHT = 9.0, 2.4  # inches: of the figure, of a panel
PATHS = 2.0  # times as high is a plane
RECORDED_REST = "No recorded position moves."
_WORDS = {
    "rests": "Nothing moves: no force and no start value sets it in motion.",
    "settles": "From {settled} on every {position} stays within 5 % of its range.",
    "not judged": "No position was recorded: whether the motion settles is not told.",
    "dies away": "At the end it still swings, less and less: {swing}.",
    "shakes": "At the end it swings without dying away: {swing}.",
    "moves on": "At the end some {position} still moves on.",
    "diverges": "{stopped} leaves the range of numbers after {stopped_at}.",
}


def buzz_text(found: Buzz) -> str:
    """Return a buzz as it is predicted beside what was played."""
    known = found.predicted
    settles = "settles" if found.settles else ""
    played = in_hertz(found.lines[0].frequency_hz) if found.lines else settles or "–"
    title = f"{found.topology}: the buzz of its contacts, predicted beside {found.played_s:g} s played"
    rows = [("frequency", in_hertz(known.frequency_hz) if known else "–", played)]
    share = f"{known.in_contact:.1%}" if known else "–"
    for one in found.contacts:
        depth = "–" if one.predicted_depth_m is None else f"{one.predicted_depth_m * 1e3:.4g} mm"
        rows += [
            (f"{one.name}: depth", depth, settles or f"{one.depth_m * 1e3:.4g} mm"),
            (f"{one.name}: in contact", share, f"{one.in_contact:.1%}"),
        ]
    width = max(len(name) for name, _, _ in rows)
    lines = [*wrapped(title), "", f"  {'':<{width}}  {'predicted':>10}  {'played':>10}"]
    lines += [f"  {name:<{width}}  {one:>10}  {other:>10}" for name, one, other in rows]
    for text in (*((found.reason,) if found.reason else ()), *found.notes):
        lines += note(text)
    return "\n".join(lines)


def buzz_document(found: Buzz) -> dict[str, Any]:
    """Return a buzz as plain data."""
    told: dict[str, Any] = document(found)
    return told


def played_text(found: Played) -> str:
    """Return what `apc simulate` prints: the summary, the method if it is not exact, the error if known."""
    summary = found.summary
    swing = ""
    if summary.swing:
        name, size, rate = summary.swing
        unit = next(one.unit for one in summary.extents if one.name == name)
        swing = f"{name} by {_quantity(size, unit)}, {rate:.3g} times a second"
    rests_in_part = summary.verdict == "rests" and summary.unrecorded
    words = (
        RECORDED_REST
        if rests_in_part
        else _WORDS[summary.verdict].format(
            position="recorded position" if summary.unrecorded else "position",
            settled=_quantity(summary.settled or 0.0, "s"),
            swing=swing,
            stopped=summary.stopped,
            stopped_at=_quantity(summary.stopped_at or 0.0, "s"),
        )
    )
    lines = [f"{found.topology}: {summary.verdict}", ""]
    lines += wrapped(words, "  ", "  ")
    rows = []
    if summary.largest_force and (summary.largest_force[1] or summary.verdict != "rests"):
        name, size, at = summary.largest_force
        rows.append(("largest force", f"{_quantity(size, 'N')}, {name} at {_quantity(at, 's')}"))
    rows += [("beyond limit", text) for text in _beyond(summary.broken)]
    if summary.overshoot:
        rows.append(("overshoot", f"{100 * summary.overshoot[1]:.3g} %, {summary.overshoot[0]}"))
    for name, distance in summary.copies:
        if not distance and summary.verdict == "rests":
            continue
        unit = next(one.unit for one in summary.extents if one.name.endswith(f".{name}"))
        rows.append(("copies", f"{name} differs by {_quantity(distance, unit)} between peers at the end"))
    if any(one for _, one in summary.work):
        done = ", ".join(f"{part} {_quantity(one, 'J')}" for part, one in summary.work)
        rows.append(("work put in", f"{done} by held forces"))
    rows.append(("recorded", f"{summary.rows} rows of {summary.signals} signals until {summary.end:g} s"))
    if found.provenance.method != EXACT:
        rows.append(("method", _method(found.provenance)))
    if found.error:
        rows.append(("error", error_text(found.error)))
    lines.append("")
    for title, text in rows:
        lines += wrapped(text, f"  {title:<15}", " " * 17)
    return "\n".join(lines)


def _beyond(broken: Sequence[Broken]) -> list[str]:
    """Return which limits were broken, in their order, each with when and by how much."""
    lines = [
        f"{one.signal} from {_quantity(one.first_s, 's')} on: at most {_quantity(one.most, one.unit)} "
        f"at {_quantity(one.at_s, 's')}, beyond {one.limit} by {_quantity(one.most - one.value, one.unit)}"
        for one in broken[:MOST_LIMITS]
    ]
    return lines + ([f"and {len(broken) - MOST_LIMITS} more"] if len(broken) > MOST_LIMITS else [])


def _quantity(value: float, unit: str) -> str:
    """Return a number with its unit, thousandths of it where it is small."""
    if value and abs(value) < 0.1 and unit in ("m", "s", "J", "N"):
        return f"{1e3 * value:.3g} m{unit}" if abs(value) >= 1e-4 else f"{1e6 * value:.3g} µ{unit}"
    return with_unit(f"{value:.3g}", unit)


def _method(provenance: Provenance) -> str:
    """Return the method with its tolerances, of each unit the smallest."""
    smallest: dict[str, float] = {}
    for one in provenance.tolerances:
        smallest[one.unit] = min(smallest.get(one.unit, one.absolute), one.absolute)
    absolute = ", ".join(f"{value:.1g} {unit}" for unit, value in smallest.items())
    return provenance.method + (f"; absolute tolerances from {absolute}" if absolute else "")


def error_text(estimate: ErrorEstimate) -> str:
    """Return what a person reads of an estimate: the signal that is worst, and what it was compared with."""
    worst = estimate.worst
    about = "none but rounding; about " if estimate.kind == "rounding" else "about "
    if worst is None or not worst.error:
        return f"{about}0 in every signal ({estimate.compared})"
    size = f"{worst.error:.1g} {worst.unit} in {worst.name} at {worst.at:g} s"
    return f"{about}{size}, {worst.relative:.1g} of its range ({estimate.compared})"


def played_document(found: Played) -> dict[str, Any]:
    """Return what `apc simulate --json` prints."""
    summary = found.summary

    def named(pair: tuple[str, float] | None, key: str) -> dict[str, Any] | None:
        return None if pair is None else {"signal": pair[0], key: pair[1]}

    force, swing = summary.largest_force, summary.swing
    return {
        "topology": found.topology,
        "verdict": summary.verdict,
        "settled_s": summary.settled,
        "diverged": {"signal": summary.stopped, "time_s": summary.stopped_at} if summary.stopped else None,
        "interrupted": found.interrupted,
        "swing": None if swing is None else {"signal": swing[0], "size": swing[1], "frequency_hz": swing[2]},
        "overshoot": named(summary.overshoot, "part"),
        "limits_broken": [document(one) for one in summary.broken],
        "largest_force": None if force is None else {"signal": force[0], "N": force[1], "time_s": force[2]},
        "copies_apart": dict(summary.copies),
        "work_J": dict(summary.work),
        "rows": summary.rows,
        "end_s": summary.end,
        "signals": [
            {
                "name": one.name,
                "unit": one.unit,
                "first": one.first,
                "last": one.last,
                "low": one.low,
                "high": one.high,
                "settled_s": one.settled,
            }
            for one in summary.extents
        ],
        "error_estimate": None if found.error is None else _error_document(found.error),
        "provenance": provenance_document(found.provenance),
    }


def _error_document(found: ErrorEstimate) -> dict[str, Any]:
    return {
        "kind": found.kind,
        "compared_with": found.compared,
        "signals": [
            {"name": one.name, "unit": one.unit, "error": one.error, "time_s": one.at, "range": one.span}
            for one in found.signals
        ],
    }


def provenance_document(found: Provenance) -> dict[str, Any]:
    """Return what made a result as plain data."""
    return {
        "topology": found.topology,
        "sha256": found.texts,
        "duration_s": found.duration_s,
        "method": found.method,
        "tolerances": {
            one.state: {"relative": one.relative, "absolute": one.absolute, "unit": one.unit}
            for one in found.tolerances
        },
        "seed": found.seed,
        "parameters": {name: {"value": value, "unit": unit} for name, value, unit in found.parameters},
        "timings_s": dict(found.timings),
        "versions": dict(found.versions),
    }


def provenance_json(found: Provenance) -> str:
    """Return what made a result as one line of JSON."""
    return json_text(provenance_document(found), indent=None)


def played_table(found: Trajectory) -> Any:
    """Return the rows of a run as a pandas table."""
    pandas = need("pandas", "data")
    columns = [signal.heading for signal in found.signals]
    return pandas.DataFrame(found.values, pandas.Index(found.time, name="time [s]"), columns)


def played_dataset(found: Trajectory) -> Any:
    """Return the rows of a run as an xarray Dataset."""
    xarray = need("xarray", "data")
    variables = {
        signal.name: ("time", found.values[:, place], {"units": signal.unit})
        for place, signal in enumerate(found.signals)
    }
    time = ("time", found.time, {"units": "s"})
    return xarray.Dataset(variables, {"time": time}, {"provenance": provenance_json(found.provenance)})


@part("draw")
def save_picture(found: Trajectory, path: Path) -> None:
    """Draw a run into a file, its format chosen by the suffix.

    Raises
    ------
    ApcError
        E878 no such format, E601 it can't be written, E875 matplotlib is not installed.
    """
    check_format(path)
    write_figure(found.plot(), path)


def played_picture(trajectory: Trajectory, ax: Any = None) -> Any:
    """Draw a trajectory, a panel a quantity, or everything into one Axes; return the matplotlib Figure.

    Parameters
    ----------
    trajectory
        What to draw.
    ax
        The matplotlib Axes to draw into; the signals must then share one unit.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    panels = _panels(trajectory.signals)
    if ax is not None:
        assert len(panels) == 1, f"one Axes can't show signals in {', '.join(panels)}"
        [(unit, places)] = panels.items()
        _panel(ax, trajectory, unit, places)
        ax.set_xlabel("time [s]")
        return ax.figure
    paths = paths_of(trajectory.signals)
    heights = [1.0] * len(panels) + [PATHS] * bool(paths)
    figure = figures.Figure(figsize=(WIDTH, HEIGHT * sum(heights) + 0.6), layout="constrained")
    axes = figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for one, (unit, places) in zip(axes, panels.items(), strict=False):
        _panel(one, trajectory, unit, places)
        if one is not axes[0]:
            one.sharex(axes[0])
        one.tick_params(labelbottom=one is axes[len(panels) - 1])
    axes[len(panels) - 1].set_xlabel("time [s]")
    if paths:
        styles = [_style(trajectory.signals, [one for one, _ in paths], place) for place, _ in paths]
        drawn = [(*pair, *style) for pair, style in zip(paths, styles, strict=True)]
        draw_paths(axes[-1], trajectory.signals, trajectory.values, drawn[:MOST_CURVES])
        _legend(axes[-1], len(drawn))
    figure.suptitle(f"{trajectory.topology}: {trajectory.summary.verdict}", fontsize=11)
    return figure


def _panels(signals: Sequence[Signal]) -> dict[str, list[int]]:
    """Return the signals' places by unit: first the known quantities, then the others as they come."""
    found: dict[str, list[int]] = {}
    for place, one in enumerate(signals):
        found.setdefault(one.unit, []).append(place)
    known = [unit for unit in QUANTITIES if unit in found]
    return {unit: found[unit] for unit in [*known, *(unit for unit in found if unit not in known)]}


def _panel(ax: Any, trajectory: Trajectory, unit: str, places: Sequence[int]) -> None:
    title, shown, scale = QUANTITIES.get(unit, ("", unit, 1.0))
    signals = trajectory.signals
    drawn = _by_group(trajectory, places) if _are_many(signals) else _one_by_one(trajectory, places)
    for time, values, label, colour, dashes, high in drawn[:MOST_CURVES]:
        if high is None:
            ax.plot(time, scale * values, color=colour, linestyle=dashes, linewidth=1.0, label=label)
        else:
            look = {"facecolor": colour, "alpha": 0.2, "linewidth": 0}
            ax.fill_between(time, scale * values, scale * high, label=label, **look)
    ax.set_ylabel(f"{title} [{shown}]" if title else f"[{shown}]")
    ax.margins(x=0)
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)
    _legend(ax, len(drawn))


# A curve, or with `high` what lies between two: time, values, its name, colour and dashes.
_Curve = tuple[Floats, Floats, str, Any, Any, Floats | None]


def _are_many(signals: Sequence[Signal]) -> bool:
    """Return whether there are more peers than colours that are told apart at a glance."""
    return len({(one.group, one.peer) for one in signals}) > MOST_COLOURS


def _one_by_one(trajectory: Trajectory, places: Sequence[int]) -> list[_Curve]:
    """Return a curve a signal, those that are the same as one: its name names them all."""
    signals = trajectory.signals
    found: list[_Curve] = []
    for alike in _alike(trajectory.values, places):
        names = ", ".join(signals[place].name for place in alike)
        label = f"{names}: identical" if len(alike) > 1 else names
        colour, dashes = _style(signals, places, alike[0])
        time, values = thinned(trajectory.time, trajectory.values[:, alike[0]])
        found.append((time, values, "\n".join(textwrap.wrap(label, LABEL)), colour, dashes, None))
    return found


def _alike(values: Floats, places: Sequence[int]) -> list[list[int]]:
    """Return places by curve: in one those that differ by nothing but rounding, of what the panel spans."""
    found: list[list[int]] = []
    off = ROUNDING * float(np.ptp(values[:, places])) if len(places) else 0.0
    for place in places:
        for one in found:
            if np.abs(values[:, place] - values[:, one[0]]).max() <= off:
                one.append(place)
                break
        else:
            found.append([place])
    return found


def _by_group(trajectory: Trajectory, places: Sequence[int]) -> list[_Curve]:
    """Return of each quantity of a group what lies between all its peers, and the two that go furthest."""
    signals = trajectory.signals
    found: list[_Curve] = []
    members: dict[tuple[str, str], list[int]] = {}
    for place in places:
        members.setdefault((signals[place].group, signals[place].local), []).append(place)
    for (group, local), own in members.items():
        values = trajectory.values[:, own]
        colour, dashes = _style(signals, places, own[0])
        if len(_alike(trajectory.values, own)) == 1:
            label = f"{group}.{local}: {counted(len(own), 'peer')}" + (", identical" if len(own) > 1 else "")
            found.append((*thinned(trajectory.time, values[:, 0]), label, colour, dashes, None))
            continue
        width = max(1, -(-len(values) // MOST_POINTS))
        starts = np.arange(0, len(values), width)
        low = np.minimum.reduceat(values.min(axis=1), starts)
        high = np.maximum.reduceat(values.max(axis=1), starts)
        label = f"{group}.{local}: all {len(own)} peers"
        found.append((trajectory.time[starts], low, label, colour, dashes, high))
        extremes = {"highest": int(values.max(axis=0).argmax()), "lowest": int(values.min(axis=0).argmin())}
        for word, column in extremes.items():
            label = f"{signals[own[column]].name}: {word}"
            look = dashes if word == "highest" else DASHES[-1]
            found.append((*thinned(trajectory.time, values[:, column]), label, colour, look, None))
    return found


def _style(signals: Sequence[Signal], places: Sequence[int], place: int) -> tuple[Any, Any]:
    """Return a signal's colour, its peer's or where these are many its group's, and its dashes in a panel."""

    def owner(signal: Signal) -> tuple[str, int]:
        return (signal.group, 0 if many else signal.peer)

    many = _are_many(signals)
    owners = list(dict.fromkeys(map(owner, signals)))
    locals_ = list(dict.fromkeys(signals[other].local for other in places))
    one = signals[place]
    colour = colours_of(len(owners))[owners.index(owner(one))]
    return colour, DASHES[locals_.index(one.local) % len(DASHES)]


def _legend(ax: Any, curves: int) -> None:
    """Name the curves beside a panel, and say how many more there are than it shows."""
    drawn = min(curves, MOST_CURVES)
    left = curves - drawn
    ax.legend(
        loc="center left",
        bbox_to_anchor=(1.01, 0.5),
        fontsize=6.5 if drawn > 10 else 8,
        ncols=1 if drawn <= 14 else 2,
        frameon=False,
        handlelength=2.6,
        title=f"and {left} more" if left else None,
        title_fontsize=7,
    )


def thinned(time: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return a curve in at most some `MOST_POINTS` points: the least and the largest of each stretch."""
    if len(time) <= MOST_POINTS:
        return time, values
    width = -(-2 * len(time) // MOST_POINTS)
    whole = len(time) // width * width
    stretches = values[:whole].reshape(-1, width)
    first = np.arange(0, whole, width)
    both = np.stack([first + stretches.argmin(axis=1), first + stretches.argmax(axis=1)], axis=1)
    kept = np.unique(np.concatenate([[0], np.sort(both, axis=1).reshape(-1), [len(time) - 1]]))
    return time[kept], values[kept]


def ensemble_text(ensemble: Ensemble) -> str:
    """Return what many runs amount to, in words of at most 80 columns."""
    from apc.simulation.ensemble import share_interval

    n = len(ensemble.runs)
    lines = [
        f"{ensemble.topology[:40]}: {counted(n, 'run')} of {float(ensemble.duration):g} s, "
        f"seed {ensemble.seed}"
    ]
    for verdict, count in ensemble.verdicts:
        low, high = share_interval(count, n)
        told = f"{100 * count / n:.3g} % (95 % sure: {100 * low:.3g} % to {100 * high:.3g} %)"
        lines.append(f"  {verdict:<10} {count:>8}   {told}")
    lines.append(f"  {'':<18}{'mean':>10} ±{'error':>8}{'5 %':>10}{'median':>10}{'95 %':>10}{'most':>10}")
    for name, label in LABELS.items():
        one = ensemble.statistics(name)
        if one is not None:
            error = f"{one.standard_error:>8.1g}" if one.count > 1 else f"{'':>8}"
            numbers = "".join(f"{value:>10.4g}" for value in (*one.quantiles, one.high))
            lines.append(f"  {label:<18}{one.mean:>10.4g} ±{error}{numbers}")
    settled = ensemble.statistics("settled")
    if settled is not None and settled.count < n:
        lines.append(f"  settled at: of the {settled.count} runs that settle")
    if ensemble.mean_square is not None:
        lines += wrapped(_beside(ensemble, ensemble.mean_square), "  ", "    ")
    if ensemble.interrupted:
        lines.append("  interrupted: there were to be more runs")
    return "\n".join(lines)


def _beside(ensemble: Ensemble, found: MeanSquare) -> str:
    """Return one sentence on what the runs say of the verdict in mean square."""
    n, calm = len(ensemble.runs), ensemble.calm
    if found.why:
        return f"in mean square: not judged: {found.why}"
    told = f"{found.verdict}, and {calm} of {counted(n, 'run')} settle or die away: "
    if found.linearized:
        return (
            f"{told}that verdict is of small motions about the start, the runs are of contacts as they come"
        )
    if found.stable is None:
        return f"{told}bounds leave that verdict open"
    if ensemble.agrees:
        return f"{told}they agree"
    if not found.stable:
        return f"{told}what makes mean squares grow is rarer, or slower, than these runs show"
    if found.settles_in is not None and found.settles_in > ensemble.duration:
        return f"{told}that takes some {found.settles_in:.2g} s, and the runs show how it begins"
    return f"{told}what moves the others is a force that goes on, which that verdict is not about"


def ensemble_document(found: Ensemble) -> dict[str, Any]:
    """Return what many runs amount to as plain data."""
    from apc.simulation.ensemble import (  # loaded where there is one, and else not needed
        QUANTILES,
        share_interval,
    )

    n, told = len(found.runs), found.mean_square
    return {
        "topology": found.topology,
        "duration_s": float(found.duration),
        "seed": found.seed,
        "runs": n,
        "interrupted": found.interrupted,
        "verdicts": {
            verdict: {"runs": count, "share": count / n, "share_95": list(share_interval(count, n))}
            for verdict, count in found.verdicts
        },
        **{name: _statistics(found.statistics(name), QUANTILES) for name in LABELS},
        "mean_square": None if told is None else {**document(told), "agrees": found.agrees},
    }


def _statistics(found: Statistics | None, quantiles: Sequence[float]) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "runs": found.count,
        "mean": found.mean,
        "standard_error": document(found.standard_error),
        "low": found.low,
        "high": found.high,
        "quantiles": dict(zip(map(str, quantiles), found.quantiles, strict=True)),
    }
