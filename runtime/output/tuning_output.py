"""The gains that do best, as text and plain data.

Takes: a `Tuning`.
Gives: its text and document; `panels_of`, the panels of its picture.
Guarantees: what is not proved is said in the first sentence; a number is shown to the digits that its error
leaves known.
Does not: compute.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.compiled import LENGTH, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import counted, enumerated, in_hertz, wrapped
from apc.lifting.numeric_model import numeric_model
from apc.output.analysis_output import changing_text, range_document, range_text
from apc.output.formatting import (
    MEANT,
    Lines,
    Plain,
    headed,
    labelled,
    notes,
    picked,
    quantity,
    record,
    sentences,
    span,
    table,
    uncertain,
)
from apc.output.pictures import legend_below, new_figure
from apc.parameter_values.overrides import Override, apply
from apc.tuning.specification import OPTIMALITY_GAP, RADIUS, SETTLING

if TYPE_CHECKING:
    from apc.compiler.compiled import Model
    from apc.tuning.tuner import ActiveConstraint, Tuning

# Digits of what is typed, and of what a limit buys.
TYPED, SHADOW_PRICES = 12, 3

# Stable regions whose intersection is drawn at most, besides those of active constraints.
MOST_SCENARIOS = 12

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
    if _is_transparency(tuning) or math.isinf(
        tuning.error
    ):  # the distance to a better optimum is unknown: no error is printed
        value = quantity(tuning.optimum, tuning.unit, SHADOW_PRICES + 1)
    of = f"{_radius(tuning)} " if tuning.objective in (RADIUS, SETTLING) else ""
    better = f"within {100 * float(OPTIMALITY_GAP):.3g} % of the global optimum"
    yield from labelled(
        ("optimum", f"{of}{value} ({tuning.evaluations:,} evaluations)" if tuning.feasible else ""),
        ("global bound", f"{better}, proved in {tuning.bound_cells:,} cells" if tuning.bound_cells else ""),
        ("margin", _margin(tuning) if tuning.feasible else ""),
    )
    yield from _proof_lines(tuning)
    yield from _changing_lines(tuning)
    if tuning.active:
        title = "Active constraints" if tuning.feasible else "Violated constraints"
        lines = (line for binding in tuning.active for line in _active_lines(tuning, binding))
        yield from headed(title, lines)
    elif any(
        gain.parameter == tuning.objective and gain.value in (gain.low, gain.high) for gain in tuning.gains
    ):
        yield from headed("Active constraints", sentences(f"the end of the range of {tuning.objective}"))


def _sentence(tuning: Tuning) -> str:
    """Return the answer in a sentence."""
    stable = "the topology is stable"
    if tuning.decay != 1:
        stable = f"motions decay by {-20 * math.log10(tuning.decay):.6g} dB/s"
    stable += " and the transparency specification is met" if tuning.transparency_metrics else ""
    ranges = [
        range_text(interval) + ", at every constant delay" * (interval == tuning.delay)
        for interval in tuning.over
    ]
    if tuning.demanded and tuning.delay:
        ranges.append(f"{tuning.delay.free.label} varying from packet to packet")
    over = f" for {enumerated(ranges)}" if ranges else ""
    if not tuning.feasible:
        return f"{tuning.topology}: no gains in these ranges were found for which {stable}{over}"
    proved = "proved" if tuning.proved else "not proved"
    best = "largest" if tuning.maximize else "smallest"
    if tuning.objective in (RADIUS, SETTLING):
        power = 2 if tuning.criterion == "mean-square" else 1  # of what a frame multiplies
        settled = tuning.frame_s * power * math.log(SETTLED) / math.log(tuning.value)
        time = f"settling time (to {100 * SETTLED:.0f} %) {quantity(settled, 's', 3)}{over}"
        least = f"{_radius(tuning)} below {tuning.value:.6g}, close to the smallest found"
        return f"{tuning.topology}: {time}, {least}; {proved}"
    value = f"{quantity(tuning.value, tuning.unit, TYPED)} is the {best} {tuning.objective}"
    return f"{tuning.topology}: {value} found for which {stable}{over}; {proved}"


def _is_transparency(tuning: Tuning) -> bool:
    """Return whether the objective is a transparency metric, or a weighted sum."""
    return tuning.objective not in (RADIUS, SETTLING, *(gain.parameter for gain in tuning.gains))


def _margin(tuning: Tuning) -> str:
    """Return the margin between the worst scenario and the limit."""
    if tuning.transparency_metrics or _is_transparency(tuning):
        return f"{math.exp(tuning.worst_case):.6g} of the specified limit in the worst scenario"
    if tuning.criterion == "passive":
        needed = (1 + tuning.worst_case) / (
            1 - tuning.worst_case
        )  # see `haptics.absolute_stability.passivity_radius`
        return f"required damping is {needed:.4g} of the device damping in the worst scenario"
    radius, most = math.exp(tuning.worst_case + tuning.allowed), math.exp(tuning.allowed)
    return f"{_radius(tuning)} {radius:.6g} in the worst scenario (limit {most:.6g})"


def _radius(tuning: Tuning) -> str:
    return "second-moment growth" if tuning.criterion == "mean-square" else "spectral radius"


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
            share = [f"{undecided_fraction:.3g} % of the box is undecided"] if undecided_fraction else []
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
        yield from labelled(("not proved", "the time limit was reached before any proof"))


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
    """Yield an active constraint, and how the optimum changes if it is relaxed."""
    other = (
        "transparency specification"
        if tuning.transparency_metrics
        else tuning.objective
        if _is_transparency(tuning)
        else "stability"
    )
    mode = f"{binding.family} mode" if binding.family else "" if math.isnan(binding.frequency_hz) else other
    if not mode and tuning.demanded and not tuning.transparency_metrics:
        mode = "bound for a delay that varies from packet to packet"
    if mode and not math.isnan(binding.frequency_hz):
        mode += f" at {in_hertz(binding.frequency_hz)}" if binding.frequency_hz else ", real eigenvalue"
    yield from wrapped(": ".join(filter(None, [_where(binding), mode])) or other, "  ", "    ")
    for label, value, unit, better in (
        binding.shadow_prices if tuning.feasible and tuning.objective not in (RADIUS, SETTLING) else ()
    ):
        shadow_prices = quantity(better, tuning.unit, SHADOW_PRICES)
        text = f"relaxing {label} = {quantity(value, unit)} by 1 % changes the optimum by {shadow_prices}"
        yield from wrapped(text, "    ", "      ")


def panels_of(model: Model, gains: int) -> tuple[bool, bool]:
    """Refuse a picture of gains without a stable region or impulse response: ApcError E996."""
    two, moves = (
        gains == 2,
        any(state.unit == "m/s" for peer_type in model.peer_types for state in peer_type.states),
    )
    if not (two or moves):
        message = "a picture without motion requires two parameters of --free"
        advice = "add a second --free PATH=LOW:HIGH"
        raise ApcError(Diagnostic("E996", SourceLocation("--plot"), message, advice=advice))
    return two, moves


def tuning_picture(tuning: Tuning, ax: Any = None) -> Any:
    """Draw two gains over the stable region, and the impulse response at the present and the optimal gains.

    Into an Axes that is given only the first of them is drawn, of any other number of gains the second; the
    first Axes is returned.
    """
    two, moves = panels_of(tuning.topologies[0], len(tuning.ranges))
    panels = [*[_draw_gains] * two, *[_draw_impulse_response] * moves]
    axes = [ax] if ax else new_figure((5.0 * len(panels), 4.4)).subplots(1, len(panels), squeeze=False)[0]
    for draw, axis in zip(panels, axes, strict=False):
        draw(tuning, axis)
    return axes[0]


def _scenario_models(tuning: Tuning) -> dict[str, Model]:
    """Return the models by scenario: of the active constraints, then at the ends of all ranges in `over`."""
    model = tuning.topologies[0]
    named = [_where(active) for active in tuning.active] or [tuning.topology]
    result = dict(zip(named, tuning.topologies, strict=True))
    counts = {group_count(group.name) for group in model.groups}
    values = [
        [Fraction(count) for count in range(int(interval.low), int(interval.high) + 1)]
        if interval.free.name in counts
        else [interval.low, interval.high]
        for interval in tuning.over
    ]
    for corner in itertools.product(*values) if values else ():
        texts = (
            f"{interval.free.label} {quantity(float(value), interval.unit)}"
            for interval, value in zip(tuning.over, corner, strict=True)
        )
        overrides = [
            Override(interval.free, value) for interval, value in zip(tuning.over, corner, strict=True)
        ]
        result.setdefault(", ".join(texts), apply(model, overrides))
    return result


def _draw_gains(tuning: Tuning, ax: Any) -> None:
    """Draw two gains at present and tuned over the intersection of the stable regions of all scenarios."""
    from apc.output.region_picture import draw_intersection  # a slow import, for pictures only
    from apc.regions.stable_region import region

    ranges = tuning.ranges[0], tuning.ranges[1]
    models = _scenario_models(tuning)
    active = {_where(binding) for binding in tuning.active}
    drawn = dict(itertools.islice(models.items(), max(MOST_SCENARIOS, len(active))))
    regions = [region(numeric_model(model), ranges, criterion=tuning.criterion) for model in drawn.values()]
    draw_intersection(ax, regions, [*drawn][: len(active)])
    title = [tuning.topology]
    if len(drawn) < len(models):
        title.append(f"{len(drawn)} of {len(models)} scenarios")
    if tuning.transparency_metrics or tuning.decay < 1:
        title.append("constraints other than stability are not drawn")
    ax.set_title("\n".join(title), fontsize=9)
    (now, best) = np.array([(gain.current, float(gain.value)) for gain in tuning.gains]).T
    ax.annotate("", best, now, arrowprops={"arrowstyle": "->", "color": "0.3"}, zorder=4)
    marks: Plain = {"clip_on": False, "zorder": 5}  # also at the ends of a range
    ax.plot(*now, "o", color="0.3", label="present", **marks)
    ax.plot(*best, "*", color="black", markersize=11, label="tuned", **marks)
    legend_below(ax)


def _draw_impulse_response(tuning: Tuning, ax: Any) -> None:
    """Draw the impulse response in the most critical scenario, with the present and the tuned gains."""
    from apc.simulation.initial_velocity import WATCHED, initial_velocity
    from apc.simulation.trajectory import simulate  # a slow import, for pictures only

    topology = tuning.topologies[0]
    for label, values in (
        ("tuned", [gain.value for gain in tuning.gains]),
        ("present", [Fraction(gain.current) for gain in tuning.gains]),
    ):
        changes = [
            Override(interval.free, value) for interval, value in zip(tuning.ranges, values, strict=True)
        ]
        excited, name = initial_velocity(apply(topology, changes))
        simulated = simulate(excited, duration=WATCHED, signals=[f"{name}.*"], jit=False)
        index = next(index for index, signal in enumerate(simulated.signals) if signal.unit == LENGTH)
        ax.plot(simulated.time, 1000 * simulated.values[:, index], label=label, zorder=3 - len(ax.lines))
        if label == "tuned":
            low, high = ax.get_ylim()
    least, most = ax.get_ylim()  # diverging curves are cut off
    ax.set_ylim(max(least, 3 * low - 2 * high), min(most, 3 * high - 2 * low))
    where = f", {_where(tuning.active[0])}" if tuning.active and _where(tuning.active[0]) else ""
    ax.set_title("\n".join(textwrap.wrap(f"Impulse response of {name}{where}", 60)), fontsize=9)
    ax.set(xlabel="time [s]", ylabel=f"{simulated.signals[index].local} [mm]")
    legend_below(ax)
    ax.grid(linewidth=0.4, alpha=0.5)


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
