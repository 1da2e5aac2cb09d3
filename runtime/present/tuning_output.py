"""The gains that do best, as text and plain data.

Takes: a `Tuning`. Gives: its text and document.
Guarantees: what is not proved is said in the first sentence; a number is shown to the digits that its error
leaves known.
Does not: compute.
"""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.compiled import LENGTH
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.words import counted, enumerated, in_hertz, wrapped
from apc.frame.overrides import Override, apply
from apc.present.analysis_output import changing_text, range_document, range_text
from apc.present.forms import (
    MEANT,
    Lines,
    Plain,
    labelled,
    notes,
    picked,
    quantity,
    record,
    span,
    table,
    uncertain,
)
from apc.present.pictures import COLOURS, legend_below, new_figure
from apc.present.region_picture import draw_panel
from apc.regions.panels import Panel
from apc.regions.stable_region import Region, region
from apc.simulation.strike import WATCHED, strike
from apc.simulation.trajectory import simulate
from apc.tuning.bound import SHARE
from apc.tuning.demands import RADIUS, SETTLING

if TYPE_CHECKING:
    from apc.compiler.compiled import Model
    from apc.tuning.front import ParetoFront
    from apc.tuning.tuner import ActiveConstraint, Tuning

# Digits of what is typed, and of what a limit buys.
TYPED, BUYS = 12, 3

# Of a motion, when it counts as died out.
SETTLED = 0.02


def tuning_text(tuning: Tuning) -> Lines:
    """Yield the gains, what is proved of them and what binds, in at most 80 columns."""
    yield from wrapped(_sentence(tuning), "", "  ")
    yield from notes(MEANT.get(tuning.criterion, ""), *tuning.left_out, *tuning.notes)
    yield ""
    rows = [("gain", "value", "before rounding", "chosen from")]
    rows += [
        (
            gain.parameter,
            quantity(float(gain.value), gain.unit, TYPED),
            quantity(gain.best, gain.unit),
            span(gain.low, gain.high, gain.unit),
        )
        for gain in tuning.gains
    ]
    yield from table(rows)
    if tuning.met or tuning.proofs:
        yield ""
    value = uncertain(tuning.best, tuning.error, tuning.unit)
    if _is_felt(tuning) or math.isinf(tuning.error):  # nobody knows how far any better one may be
        value = quantity(tuning.best, tuning.unit, BUYS + 1)
    better = f"no gains in these ranges do better by {100 * float(SHARE):.3g} %"
    yield from labelled(
        ("before rounding", f"{value}, the best of {tuning.looked:,} points" if tuning.met else ""),
        ("no others", f"{better}, proved in {tuning.bounded:,} cells" if tuning.bounded else ""),
        ("margin", _margin(tuning) if tuning.met else ""),
    )
    yield from _proof_lines(tuning)
    yield from _changing_lines(tuning)
    if tuning.binding:
        yield "\n  what binds" if tuning.met else "\n  what is in the way"
        for binding in tuning.binding:
            yield from _binding_lines(tuning, binding)
    elif any(gain.parameter == tuning.aim and gain.value in (gain.low, gain.high) for gain in tuning.gains):
        yield f"\n  nothing binds {tuning.aim} but the end of its range"


def _sentence(tuning: Tuning) -> str:
    """Return the answer in a sentence."""
    stable = "the scene is stable"
    if tuning.decay != 1:
        stable = f"motions die out by {-20 * math.log10(tuning.decay):.6g} dB a second"
    stable += " and what is felt is as asked" if tuning.felt else ""
    ranges = [
        range_text(interval) + ", at every constant delay" * (interval == tuning.delay)
        for interval in tuning.over
    ]
    if tuning.demanded and tuning.delay:
        ranges.append(f"{tuning.delay.free.label} changing from packet to packet")
    over = f" for {enumerated(ranges)}" if ranges else ""
    if not tuning.met:
        return f"{tuning.topology}: no gains were found in these ranges with which {stable}{over}"
    proved = "proved" if tuning.proved else "not proved"
    best = "largest" if tuning.larger else "least"
    if tuning.aim in (RADIUS, SETTLING):
        power = 2 if tuning.criterion == "mean-square" else 1  # of what a frame multiplies
        settled = tuning.frame_s * power * math.log(SETTLED) / math.log(tuning.value)
        time = f"all motions die out but for {100 * SETTLED:.0f} % within {quantity(settled, 's', 3)}{over}"
        least = f"with {_radius(tuning)} below {tuning.value:.6g}, next to the least found; it is {proved}"
        return f"{tuning.topology}: {time}, {least}"
    value = f"{quantity(tuning.value, tuning.unit, TYPED)} is the {best} {tuning.aim}"
    return f"{tuning.topology}: {value} found with which {stable}{over}; it is {proved}"


def _is_felt(tuning: Tuning) -> bool:
    """Say whether the aim is what is felt, or a weighted sum."""
    return tuning.aim not in (RADIUS, SETTLING, *(gain.parameter for gain in tuning.gains))


def _margin(tuning: Tuning) -> str:
    """Return how near the worst scenario is to what is allowed."""
    if tuning.felt or _is_felt(tuning):
        return f"{math.exp(tuning.worst):.6g} of what is allowed in the worst scenario"
    if tuning.criterion == "passive":
        needed = (1 + tuning.worst) / (1 - tuning.worst)  # see `hands.passivity.passive_growth`
        return f"passive hands need {needed:.4g} of the damping there is in the worst scenario"
    radius, most = math.exp(tuning.worst + tuning.allowed), math.exp(tuning.allowed)
    return f"{_radius(tuning)} of {radius:.6g} in the worst scenario, {most:.6g} allowed"


def _radius(tuning: Tuning) -> str:
    return "a mean-square radius" if tuning.criterion == "mean-square" else "a spectral radius"


def _proof_lines(tuning: Tuning) -> Lines:
    """Yield what was proved, and of what it was not."""
    proved = [proof for proof in tuning.proofs if proof.proof.stable]
    cells = sum(item.proof.cells for item in proved)
    if proved:
        text = counted(cells, "cell" if tuning.over else "analysis", ",d").replace("analysiss", "analyses")
        many = f"for each of {len(proved)} numbers of peers, " if proved[0].counts else ""
        yield from labelled(("proved", f"{many}{proved[0].proof.verdict} ({text})"))
    left: dict[str, list[str]] = {}
    for proof in tuning.proofs:
        if not proof.proof.stable:
            open_share = 100 * proof.proof.open_share
            share = [f"{open_share:.3g} % of the box is left open"] if open_share else []
            open_verdict = [] if proof.proof.notes else [proof.proof.verdict]
            said = ", ".join([*open_verdict, *share, *proof.proof.notes])
            left.setdefault(said, []).append(", ".join(f"{label} {number}" for label, number in proof.counts))
    for said, where in left.items():
        yield from labelled(("not proved", "; ".join(filter(None, [", ".join(filter(None, where)), said]))))
    if tuning.met and not tuning.proofs:
        yield from labelled(("not proved", "the time was up before any proof"))


def _changing_lines(tuning: Tuning) -> Lines:
    """Yield what is proved of the gains where the delay changes from packet to packet."""
    if tuning.delay is None:
        return
    gains_of: dict[str, list[str]] = {}
    for counts, found in tuning.changing:
        numbers = ", ".join(f"{label} {number}" for label, number in counts)
        gains_of.setdefault(changing_text(found, tuning.delay), []).append(numbers)
    for text, where in gains_of.items():
        yield from wrapped(text, "  ", "    ")
        if any(where):
            yield from wrapped(f"with {'; '.join(where)}", "    ", "    ")


def _where(binding: ActiveConstraint) -> str:
    return ", ".join(f"{label} {quantity(value, unit)}" for label, value, unit in binding.where)


def _binding_lines(tuning: Tuning, binding: ActiveConstraint) -> Lines:
    other = "what is felt" if tuning.felt else tuning.aim if _is_felt(tuning) else "stability"
    mode = f"{binding.shape} mode" if binding.shape else "" if math.isnan(binding.frequency_hz) else other
    if not mode and tuning.demanded and not tuning.felt:
        mode = "the bound for a delay that changes from packet to packet"
    mode += f" at {in_hertz(binding.frequency_hz)}" if mode and not math.isnan(binding.frequency_hz) else ""
    yield from wrapped(": ".join(filter(None, [_where(binding), mode])) or other, "    ", "      ")
    for label, value, unit, better in (
        binding.buys if tuning.met and tuning.aim not in (RADIUS, SETTLING) else ()
    ):
        buys = quantity(better, tuning.unit, BUYS)
        text = f"1 % less of {label} = {quantity(value, unit)} buys {buys}"
        yield from wrapped(text, "      ", "        ")


def panels_of(system: Model, gains: int) -> tuple[bool, bool]:
    """Say whether a picture of so many gains has a stable region, and a strike: ApcError E996 if neither."""
    two, moves = gains == 2, any(state.unit == "m/s" for kind in system.kinds for state in kind.states)
    if not (two or moves):
        what = "nothing moves in this scene, and a stable region is of two gains"
        raise ApcError(Diagnostic("E996", SourceLocation("--plot"), what, hint='another --free "PATH=LO:HI"'))
    return two, moves


def tuning_picture(tuning: Tuning, ax: Any = None) -> Any:
    """Draw two gains over the stable regions, and what a strike comes to now and with the gains found.

    Into an Axes that is given only the first of them is drawn, of any other number of gains the second; the
    first Axes is returned.
    """
    two, moves = panels_of(tuning.scenes[0], len(tuning.ranges))
    panels = [*[_draw_gains] * two, *[_draw_struck] * moves]
    axes = [ax] if ax else new_figure((5.0 * len(panels), 4.4)).subplots(1, len(panels), squeeze=False)[0]
    for draw, axis in zip(panels, axes, strict=False):
        draw(tuning, axis)
    return axes[0]


def _draw_gains(tuning: Tuning, ax: Any) -> None:
    """Draw two gains now and then, over the stable regions of the scenes that limit them."""
    regions: list[Region] = []
    ranges = tuning.ranges[0], tuning.ranges[1]
    for where, scene in zip(
        map(_where, tuning.binding) if tuning.binding else [""], tuning.scenes, strict=True
    ):
        name = where or tuning.topology
        if name not in [region.topology for region in regions]:
            regions.append(replace(region(scene, ranges, criterion=tuning.criterion), topology=name))
    more = "; what is asked beside stability is not drawn" if tuning.felt or tuning.decay < 1 else ""
    draw_panel(ax, f"{tuning.topology}{more}", Panel("", tuple(regions), (1,) * len(regions), ()))
    (now, best) = np.array([(gain.now, float(gain.value)) for gain in tuning.gains]).T
    ax.annotate("", best, now, arrowprops={"arrowstyle": "->", "color": "0.3"})
    whole: Plain = {"clip_on": False, "zorder": 5}  # where an end of a range is best, too
    ax.plot(*now, "o", color="0.3", label="now", **whole)
    ax.plot(*best, "*", color="black", markersize=11, label="found", **whole)
    legend_below(ax)


def _draw_struck(tuning: Tuning, ax: Any) -> None:
    """Draw where a struck device goes in the scene that limits gains most, now and with those found."""
    scene = tuning.scenes[0]
    for label, values in (
        ("found", [gain.value for gain in tuning.gains]),
        ("now", [Fraction(gain.now) for gain in tuning.gains]),
    ):
        changes = [
            Override(interval.free, value) for interval, value in zip(tuning.ranges, values, strict=True)
        ]
        struck, name = strike(apply(scene, changes))
        played = simulate(struck, duration=WATCHED, signals=[f"{name}.*"], jit=False)
        place = next(place for place, signal in enumerate(played.signals) if signal.unit == LENGTH)
        ax.plot(played.time, 1000 * played.values[:, place], label=label, zorder=3 - len(ax.lines))
        if label == "found":
            low, high = ax.get_ylim()
    least, most = ax.get_ylim()  # what grows without end is cut off
    ax.set_ylim(max(least, 3 * low - 2 * high), min(most, 3 * high - 2 * low))
    where = f", {_where(tuning.binding[0])}" if tuning.binding and _where(tuning.binding[0]) else ""
    ax.set_title(f"{name} struck{where}", fontsize=9)
    ax.set(xlabel="time (s)", ylabel=f"{played.signals[place].local} (mm)")
    ax.legend(frameon=False, fontsize=8)
    ax.grid(linewidth=0.4, alpha=0.5)


def front_text(front: ParetoFront) -> Lines:
    """Yield the designs as a table, those at the ends and at the knee named, in at most 80 columns."""
    best = "largest" if front.larger else "least"
    yield from wrapped(
        f"{front.topology}: the {best} {front.aim} for each bound on {front.against}", "", "  "
    )
    yield from notes(MEANT.get(front.criterion, ""), *front.left_out, *front.notes)
    yield ""
    names_of = [name for name, _, _ in front.designs[0].gains]
    apart = front.aim not in names_of  # what is best is in no column of the gains
    heads = ["felt", best] if apart else [front.against]  # the title names both
    # An end is no knee; beside a column of what is best there is no room for names.
    names = {} if apart else {front.knee: "knee", 0: "least felt", len(front.designs) - 1: best}
    rows = [(*heads, *names_of, "", "")]
    for place, design in enumerate(front.designs):
        gains = (quantity(value, unit, TYPED) for _, value, unit in design.gains)
        proved = "" if design.proved else "not proved"
        value = [quantity(design.value, front.unit, 4)] * apart
        rows.append(
            (quantity(design.felt, front.against_unit, 5), *value, *gains, names.get(place, ""), proved)
        )
    yield from table(rows)
    if apart:
        knee = quantity(front.designs[front.knee].felt, front.against_unit, 5)
        yield from labelled(("knee", f"{knee} felt"))


def front_picture(front: ParetoFront, ax: Any = None) -> Any:
    """Draw the front, three designs named; return the matplotlib Axes."""
    ax = new_figure((5.2, 3.8)).subplots() if ax is None else ax
    x, y = (np.array([getattr(design, name) for design in front.designs]) for name in ("felt", "value"))
    ax.plot(x, y, "o-", markersize=4, color=COLOURS[0])
    ax.set(xlabel=f"{front.against} ({front.against_unit})", ylabel=f"{front.aim} ({front.unit})")
    ax.set_title(front.topology, fontsize=9)
    end = "largest" if front.larger else "least"
    for place, name in {front.knee: "knee", 0: "least felt", len(x) - 1: end}.items():
        at = (float(x[place]), float(y[place]))
        ax.annotate(name, at, xytext=(6, 6 if y[0] > y[-1] else -12), textcoords="offset points", fontsize=8)
    ax.margins(0.12)  # room for the names
    ax.grid(linewidth=0.4, alpha=0.5)
    return ax


def tuning_document(tuning: Tuning) -> Plain:
    """Return the gains, what is proved of them and what binds as plain data."""
    proofs = [
        {"counts": dict(proof.counts), "verdict": proof.proof.verdict, "stable": proof.proof.stable}
        | {"cells": proof.proof.cells, "open_share": proof.proof.open_share}
        for proof in tuning.proofs
    ]
    ranges = {
        "over": [range_document(interval) for interval in tuning.over],
        "delay": None if tuning.delay is None else range_document(tuning.delay),
        "changing": [
            {"counts": dict(counts), **picked(found, "proved_to", "unstable", "note")}
            for counts, found in tuning.changing
        ],
    }
    return record(tuning, {**ranges, "proofs": proofs})
