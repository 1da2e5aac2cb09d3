"""The gains that do best, as text and plain data.

Takes: a `Tuning`.
Gives: its text and document; `panels_of`, the panels of its picture.
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
from apc.compiler.wording import counted, enumerated, in_hertz, wrapped
from apc.frame.overrides import Override, apply
from apc.output.analysis_output import changing_text, range_document, range_text
from apc.output.formatting import (
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
from apc.output.pictures import COLOURS, legend_below, new_figure
from apc.output.region_picture import draw_panel
from apc.regions.panels import Panel
from apc.regions.stable_region import Region, region
from apc.simulation.initial_velocity import WATCHED, initial_velocity
from apc.simulation.trajectory import simulate
from apc.tuning.optimality_bound import SHARE
from apc.tuning.specification import RADIUS, SETTLING

if TYPE_CHECKING:
    from apc.compiler.compiled import Model
    from apc.tuning.pareto_front import ParetoFront
    from apc.tuning.tuner import ActiveConstraint, Tuning

# Digits of what is typed, and of what a limit buys.
TYPED, SHADOW_PRICES = 12, 3

# Of a motion, when it counts as died out.
SETTLED = 0.02


def tuning_text(tuning: Tuning) -> Lines:
    """Yield the gains, their proof and the active constraints, in at most 80 columns."""
    yield from wrapped(_sentence(tuning), "", "  ")
    yield from notes(MEANT.get(tuning.criterion, ""), *tuning.limitations, *tuning.notes)
    yield ""
    rows = [("gain", "value", "optimum", "range")]
    rows += [
        (
            gain.parameter,
            quantity(float(gain.value), gain.unit, TYPED),
            quantity(gain.optimum, gain.unit),
            span(gain.low, gain.high, gain.unit),
        )
        for gain in tuning.gains
    ]
    yield from table(rows)
    if tuning.feasible or tuning.proofs:
        yield ""
    value = uncertain(tuning.optimum, tuning.error, tuning.unit)
    if _is_transparency(tuning) or math.isinf(tuning.error):  # nobody knows how far any better one may be
        value = quantity(tuning.optimum, tuning.unit, SHADOW_PRICES + 1)
    better = f"no gains in these ranges do better by {100 * float(SHARE):.3g} %"
    yield from labelled(
        ("optimum", f"{value}, the best of {tuning.evaluations:,} points" if tuning.feasible else ""),
        ("no others", f"{better}, proved in {tuning.bound_cells:,} cells" if tuning.bound_cells else ""),
        ("margin", _margin(tuning) if tuning.feasible else ""),
    )
    yield from _proof_lines(tuning)
    yield from _changing_lines(tuning)
    if tuning.active:
        yield "\n  what binds" if tuning.feasible else "\n  what is in the way"
        for binding in tuning.active:
            yield from _active_lines(tuning, binding)
    elif any(
        gain.parameter == tuning.objective and gain.value in (gain.low, gain.high) for gain in tuning.gains
    ):
        yield f"\n  nothing binds {tuning.objective} but the end of its range"


def _sentence(tuning: Tuning) -> str:
    """Return the answer in a sentence."""
    stable = "the topology is stable"
    if tuning.decay != 1:
        stable = f"motions die out by {-20 * math.log10(tuning.decay):.6g} dB a second"
    stable += " and what is felt is as asked" if tuning.transparency_metrics else ""
    ranges = [
        range_text(interval) + ", at every constant delay" * (interval == tuning.delay)
        for interval in tuning.over
    ]
    if tuning.demanded and tuning.delay:
        ranges.append(f"{tuning.delay.free.label} changing from packet to packet")
    over = f" for {enumerated(ranges)}" if ranges else ""
    if not tuning.feasible:
        return f"{tuning.topology}: no gains were found in these ranges with which {stable}{over}"
    proved = "proved" if tuning.proved else "not proved"
    best = "largest" if tuning.maximize else "least"
    if tuning.objective in (RADIUS, SETTLING):
        power = 2 if tuning.criterion == "mean-square" else 1  # of what a frame multiplies
        settled = tuning.frame_s * power * math.log(SETTLED) / math.log(tuning.value)
        time = f"all motions die out but for {100 * SETTLED:.0f} % within {quantity(settled, 's', 3)}{over}"
        least = f"with {_radius(tuning)} below {tuning.value:.6g}, next to the least found; it is {proved}"
        return f"{tuning.topology}: {time}, {least}"
    value = f"{quantity(tuning.value, tuning.unit, TYPED)} is the {best} {tuning.objective}"
    return f"{tuning.topology}: {value} found with which {stable}{over}; it is {proved}"


def _is_transparency(tuning: Tuning) -> bool:
    """Return whether the objective is a transparency metric, or a weighted sum."""
    return tuning.objective not in (RADIUS, SETTLING, *(gain.parameter for gain in tuning.gains))


def _margin(tuning: Tuning) -> str:
    """Return the margin between the worst scenario and the limit."""
    if tuning.transparency_metrics or _is_transparency(tuning):
        return f"{math.exp(tuning.worst_case):.6g} of what is allowed in the worst scenario"
    if tuning.criterion == "passive":
        needed = (1 + tuning.worst_case) / (
            1 - tuning.worst_case
        )  # see `haptics.absolute_stability.passivity_radius`
        return f"passive hands need {needed:.4g} of the damping there is in the worst scenario"
    radius, most = math.exp(tuning.worst_case + tuning.allowed), math.exp(tuning.allowed)
    return f"{_radius(tuning)} of {radius:.6g} in the worst scenario, {most:.6g} allowed"


def _radius(tuning: Tuning) -> str:
    return "a mean-square radius" if tuning.criterion == "mean-square" else "a spectral radius"


def _proof_lines(tuning: Tuning) -> Lines:
    """Yield the proof, with its scenarios and exceptions."""
    proved = [proof for proof in tuning.proofs if proof.proof.stable]
    cells = sum(item.proof.cells for item in proved)
    if proved:
        text = counted(cells, "cell" if tuning.over else "analysis", ",d").replace("analysiss", "analyses")
        many = f"for each of {len(proved)} numbers of peers, " if proved[0].counts else ""
        yield from labelled(("proved", f"{many}{proved[0].proof.verdict} ({text})"))
    left: dict[str, list[str]] = {}
    for proof in tuning.proofs:
        if not proof.proof.stable:
            undecided_fraction = 100 * proof.proof.undecided_fraction
            share = [f"{undecided_fraction:.3g} % of the box is left open"] if undecided_fraction else []
            open_verdict = [] if proof.proof.notes else [proof.proof.verdict]
            printed = ", ".join([*open_verdict, *share, *proof.proof.notes])
            left.setdefault(printed, []).append(
                ", ".join(f"{label} {number}" for label, number in proof.counts)
            )
    for printed, where in left.items():
        yield from labelled(
            ("not proved", "; ".join(filter(None, [", ".join(filter(None, where)), printed])))
        )
    if tuning.feasible and not tuning.proofs:
        yield from labelled(("not proved", "the time was up before any proof"))


def _changing_lines(tuning: Tuning) -> Lines:
    """Yield the stability of the tuned gains under a time-varying delay, by numbers of peers."""
    if tuning.delay is None:
        return
    cases_by_text: dict[str, list[str]] = {}
    for counts, result in tuning.changing:
        numbers = ", ".join(f"{label} {number}" for label, number in counts)
        cases_by_text.setdefault(changing_text(result, tuning.delay), []).append(numbers)
    for text, cases in cases_by_text.items():
        yield from wrapped(text, "  ", "    ")
        if any(cases):
            yield from wrapped(f"with {'; '.join(cases)}", "    ", "    ")


def _where(binding: ActiveConstraint) -> str:
    return ", ".join(f"{label} {quantity(value, unit)}" for label, value, unit in binding.where)


def _active_lines(tuning: Tuning, binding: ActiveConstraint) -> Lines:
    other = (
        "what is felt"
        if tuning.transparency_metrics
        else tuning.objective
        if _is_transparency(tuning)
        else "stability"
    )
    mode = f"{binding.family} mode" if binding.family else "" if math.isnan(binding.frequency_hz) else other
    if not mode and tuning.demanded and not tuning.transparency_metrics:
        mode = "the bound for a delay that changes from packet to packet"
    mode += f" at {in_hertz(binding.frequency_hz)}" if mode and not math.isnan(binding.frequency_hz) else ""
    yield from wrapped(": ".join(filter(None, [_where(binding), mode])) or other, "    ", "      ")
    for label, value, unit, better in (
        binding.shadow_prices if tuning.feasible and tuning.objective not in (RADIUS, SETTLING) else ()
    ):
        shadow_prices = quantity(better, tuning.unit, SHADOW_PRICES)
        text = f"1 % less of {label} = {quantity(value, unit)} buys {shadow_prices}"
        yield from wrapped(text, "      ", "        ")


def panels_of(system: Model, gains: int) -> tuple[bool, bool]:
    """Refuse a picture of gains without a stable region or impulse response: ApcError E996."""
    two, moves = (
        gains == 2,
        any(state.unit == "m/s" for peer_type in system.peer_types for state in peer_type.states),
    )
    if not (two or moves):
        message = "nothing moves in this topology, and a stable region is of two gains"
        raise ApcError(
            Diagnostic("E996", SourceLocation("--plot"), message, hint='another --free "PATH=LO:HI"')
        )
    return two, moves


def tuning_picture(tuning: Tuning, ax: Any = None) -> Any:
    """Draw two gains over the stable regions, and the impulse response at the present and the optimal gains.

    Into an Axes that is given only the first of them is drawn, of any other number of gains the second; the
    first Axes is returned.
    """
    two, moves = panels_of(tuning.topologies[0], len(tuning.ranges))
    panels = [*[_draw_gains] * two, *[_draw_struck] * moves]
    axes = [ax] if ax else new_figure((5.0 * len(panels), 4.4)).subplots(1, len(panels), squeeze=False)[0]
    for draw, axis in zip(panels, axes, strict=False):
        draw(tuning, axis)
    return axes[0]


def _draw_gains(tuning: Tuning, ax: Any) -> None:
    """Draw two gains now and then, over the stable regions of the models that limit them."""
    regions: list[Region] = []
    ranges = tuning.ranges[0], tuning.ranges[1]
    for where, topology in zip(
        map(_where, tuning.active) if tuning.active else [""], tuning.topologies, strict=True
    ):
        name = where or tuning.topology
        if name not in [region.topology for region in regions]:
            regions.append(replace(region(topology, ranges, criterion=tuning.criterion), topology=name))
    more = (
        "; what is asked beside stability is not drawn"
        if tuning.transparency_metrics or tuning.decay < 1
        else ""
    )
    draw_panel(ax, f"{tuning.topology}{more}", Panel("", tuple(regions), (1,) * len(regions), ()))
    (now, best) = np.array([(gain.current, float(gain.value)) for gain in tuning.gains]).T
    ax.annotate("", best, now, arrowprops={"arrowstyle": "->", "color": "0.3"})
    whole: Plain = {"clip_on": False, "zorder": 5}  # where an end of a range is best, too
    ax.plot(*now, "o", color="0.3", label="now", **whole)
    ax.plot(*best, "*", color="black", markersize=11, label="found", **whole)
    legend_below(ax)


def _draw_struck(tuning: Tuning, ax: Any) -> None:
    """Draw where a struck device goes in the model that limits gains most, now and with those found."""
    topology = tuning.topologies[0]
    for label, values in (
        ("found", [gain.value for gain in tuning.gains]),
        ("now", [Fraction(gain.current) for gain in tuning.gains]),
    ):
        changes = [
            Override(interval.free, value) for interval, value in zip(tuning.ranges, values, strict=True)
        ]
        struck, name = initial_velocity(apply(topology, changes))
        simulated = simulate(struck, duration=WATCHED, signals=[f"{name}.*"], jit=False)
        index = next(index for index, signal in enumerate(simulated.signals) if signal.unit == LENGTH)
        ax.plot(simulated.time, 1000 * simulated.values[:, index], label=label, zorder=3 - len(ax.lines))
        if label == "found":
            low, high = ax.get_ylim()
    least, most = ax.get_ylim()  # diverging curves are cut off
    ax.set_ylim(max(least, 3 * low - 2 * high), min(most, 3 * high - 2 * low))
    where = f", {_where(tuning.active[0])}" if tuning.active and _where(tuning.active[0]) else ""
    ax.set_title(f"{name} struck{where}", fontsize=9)
    ax.set(xlabel="time (s)", ylabel=f"{simulated.signals[index].local} (mm)")
    ax.legend(frameon=False, fontsize=8)
    ax.grid(linewidth=0.4, alpha=0.5)


def pareto_front_text(front: ParetoFront) -> Lines:
    """Yield the designs as a table, those at the ends and at the knee named, in at most 80 columns."""
    best = "largest" if front.maximize else "least"
    yield from wrapped(
        f"{front.topology}: the {best} {front.objective} for each bound on {front.tradeoff}", "", "  "
    )
    yield from notes(MEANT.get(front.criterion, ""), *front.limitations, *front.notes)
    yield ""
    names_of = [name for name, _, _ in front.designs[0].gains]
    separation = front.objective not in names_of  # what is best is in no column of the gains
    heads = ["felt", best] if separation else [front.tradeoff]  # the title names both
    # An end is no knee; beside a column of what is best there is no room for names.
    names = {} if separation else {front.knee: "knee", 0: "least felt", len(front.designs) - 1: best}
    rows = [(*heads, *names_of, "", "")]
    for index, design in enumerate(front.designs):
        gains = (quantity(value, unit, TYPED) for _, value, unit in design.gains)
        proved = "" if design.proved else "not proved"
        value = [quantity(design.value, front.unit, 4)] * separation
        rows.append(
            (
                quantity(design.transparency, front.tradeoff_unit, 5),
                *value,
                *gains,
                names.get(index, ""),
                proved,
            )
        )
    yield from table(rows)
    if separation:
        knee = quantity(front.designs[front.knee].transparency, front.tradeoff_unit, 5)
        yield from labelled(("knee", f"{knee} felt"))


def pareto_front_picture(front: ParetoFront, ax: Any = None) -> Any:
    """Draw the front, three designs named; return the matplotlib Axes."""
    ax = new_figure((5.2, 3.8)).subplots() if ax is None else ax
    x, y = (
        np.array([getattr(design, name) for design in front.designs]) for name in ("transparency", "value")
    )
    ax.plot(x, y, "o-", markersize=4, color=COLOURS[0])
    ax.set(xlabel=f"{front.tradeoff} ({front.tradeoff_unit})", ylabel=f"{front.objective} ({front.unit})")
    ax.set_title(front.topology, fontsize=9)
    end = "largest" if front.maximize else "least"
    for index, name in {front.knee: "knee", 0: "least felt", len(x) - 1: end}.items():
        at = (float(x[index]), float(y[index]))
        ax.annotate(name, at, xytext=(6, 6 if y[0] > y[-1] else -12), textcoords="offset points", fontsize=8)
    ax.margins(0.12)  # room for the names
    ax.grid(linewidth=0.4, alpha=0.5)
    return ax


def tuning_document(tuning: Tuning) -> Plain:
    """Return the gains, their proof and the active constraints as plain data."""
    proofs = [
        {"counts": dict(proof.counts), "verdict": proof.proof.verdict, "stable": proof.proof.stable}
        | {"cells": proof.proof.cells, "undecided_fraction": proof.proof.undecided_fraction}
        for proof in tuning.proofs
    ]
    ranges = {
        "over": [range_document(interval) for interval in tuning.over],
        "delay": None if tuning.delay is None else range_document(tuning.delay),
        "changing": [
            {"counts": dict(counts), **picked(result, "proved_to", "unstable", "note")}
            for counts, result in tuning.changing
        ],
    }
    return record(tuning, {**ranges, "proofs": proofs})
