"""Margins and sensitivities of what second moments grow by, over the network as it is.

Takes: a `CompiledSystem` with unreliable links, and its margins over the nominal network.
Gives: `network_margins`, `network_sensitivities`.
Guarantees: on either side of a margin, by its error, bounds on the growth of second moments decide, or the
note says of which they don't.
Does not: vary a delay or a period; look where one growth takes long (see `Growth.quick`); prove that nothing
changes between two values it looked at.

A derivative at v is the difference quotient D(h) of values at v − h and v + h, extrapolated from two steps
(Richardson): D = (4 D(h/2) − D(h))/3.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Place
from apc.compiler.timings import part
from apc.compiler.words import counted
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared
from apc.frame.names import Free, named_times, unit_of, value_now
from apc.frame.overrides import Override
from apc.moments.network_verdict import Growth, growth
from apc.network.nominal import channel_numbers
from apc.threads import single_threaded
from apc.vary.crossing import Search, search
from apc.vary.evaluator import free_parameters
from apc.vary.growth import BOUNDED, MEAN_SQUARE, GrowthEvaluator, GrowthLine, allowed, growth_at
from apc.vary.line import SAMPLES
from apc.vary.margins import GROWTH, NOT_STABLE, Margin, Margins, coupler_parameters, not_looked
from apc.vary.sensitivity import Sensitivities, Sensitivity, varied

PLACE = Place("over the network")

# The longer of two steps of a difference, relatively: what is left out, its fourth power, is then as small as
# what values right to some 1e-11 leave open.
STEP = 2.0**-7

# Values of a probability or jitter to look at, from the present one to the largest.
SHARES = 16

# More numbers than this are not varied: at some ten milliseconds a value they would take a minute.
MOST_VARIED = 60

# More numbers times states than this are looked at only if asked: a score of values of each number, of some
# milliseconds and one more for every two states, are half a minute.
MOST_IN_PASSING = 500

# What grows is called so.
MOMENTS = "second moments"


def network_margins(
    system: CompiledSystem, prepared: Prepared, nominal: Margins, *, quick: bool = False
) -> Margins:
    """Find how much each stiffness, damping, probability and jitter may grow, stable in mean square.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    nominal
        The margins over the nominal network: how far to look from a value of 0.
    quick
        Whether margins that take long are left out.
    """
    with (
        part("margins"),
        single_threaded(),
        finite_equations(system.origin.topology),
        np.errstate(all="ignore"),
    ):
        free = [*coupler_parameters(system), *_of_channels(system)]
        states = max(len(kind.states) for kind in system.kinds)
        if quick and len(free) * states > MOST_IN_PASSING:
            count = f"{len(free)} numbers of {states} states"
            return Margins((), f"not looked for in passing: {count} (apc analyze --margins does)")
        if why := _too_many(len(free)):
            return Margins((), f"not looked for: {why}")
        here = growth(system, prepared)
        if not here.why and not here.stable:
            known = "stable" if here.stable is False else "proved stable"
            return Margins((), NOT_STABLE.format(f"{known} in mean square"))
        if why := _not_varied(here):
            return Margins((), f"not looked for: {why}")
        scales = {row.parameter: row.value or row.scanned / GROWTH for row in nominal.rows}
        open_rows = {row.parameter for row in nominal.rows if row.note}
        unscaled = {item.label for item in free if not nominal.rows or item.label in open_rows}
        rows: list[Margin] = []
        notes, open_sides, looked = [], [], 0
        beyond: dict[str, list[str]] = {}
        for item in free:
            samples = _samples(system, item, scales)
            if item.label in unscaled and len(samples) == 1:
                rows.append(not_looked(system, item, "from 0 nothing says how far"))
                continue
            line = GrowthLine(
                GrowthEvaluator(system, (item,), prepared, PLACE), np.array(samples), {samples[0]: here}
            )
            result = search(line, first=True)
            looked += result.looked
            if not result.enters:
                continue
            rows.append(_margin(system, item, result))
            if result.why:
                beyond.setdefault(result.why, []).append(item.label)
            if result.edges and result.edges[0].proof != BOUNDED[MEAN_SQUARE]:
                open_sides.append(f"{item.label} ({result.edges[0].proof})")
    notes += [f"beyond these values of {', '.join(labels)}, {why}" for why, labels in beyond.items()]
    if open_sides:
        notes.append(f"not bounded on either side: {', '.join(open_sides)}")
    notes.append(
        f"{counted(looked, 'value')} were looked at: a narrow change of the verdict could hide between two"
    )
    notes.append("delays and periods were not varied: they change the order of events")
    return Margins(tuple(rows), "; ".join(notes))


def _too_many(count: int) -> str:
    """Return why so many numbers are not varied, "" where they are."""
    if count <= MOST_VARIED:
        return ""
    return f"over this network, {count} numbers take too long to vary (apc critical varies one)"


def _not_varied(growth: Growth) -> str:
    """Return why a scene is not looked at for many values, "" where it is."""
    if growth.why:
        return f"over the network, the scene is not judged: {growth.why}"
    if not growth.quick:
        return (
            "over this network, to judge one value takes long (apc critical looks at those of one parameter)"
        )
    return ""


def _of_channels(system: CompiledSystem) -> list[Free]:
    """Return what links lose and delay packets by, where it follows from nothing else."""
    numbers = channel_numbers(system)
    times = [Free(timing.name) for timing in named_times(system) if timing.formula is None]
    return [free for free in (*free_parameters(system), *times) if free.name in numbers]


def _samples(system: CompiledSystem, free: Free, scales: dict[str, float]) -> list[float]:
    """Return the values to look at, the present one first."""
    present, most = value_now(system, free), allowed(system, free)[1]
    if free.name in channel_numbers(system):
        delays = [
            value_now(system, Free(link.delay))
            for link in system.links
            if link.channel is not None and link.channel.jitter == free.name
        ]
        return [float(value) for value in np.linspace(present, min([most, *delays]), SHARES + 1)]
    scale = abs(present) or scales.get(free.label, 0.0)
    if not scale:
        return [present]
    first, last = (scale if present else scale / GROWTH), scale * GROWTH
    ahead = np.geomspace(first, last, round(SAMPLES * np.log10(last / first)) + 1)
    return [present, *(float(item) for item in ahead if present < item <= most)]


def _margin(system: CompiledSystem, free: Free, search: Search) -> Margin:
    """Return a margin that was found, or how far it was looked for."""
    present, crossing = value_now(system, free), search.edges[0] if search.edges else None
    return Margin(
        parameter=free.label,
        unit=unit_of(system, free.name),
        present=present,
        value=None if crossing is None else crossing.value,
        error=None if crossing is None else crossing.error,
        factor=crossing.value / present if crossing is not None and present else None,
        frequency_hz=None,
        kind="" if crossing is None else crossing.kind,
        scanned=search.scanned[1],
    )


def network_sensitivities(system: CompiledSystem, prepared: Prepared) -> Sensitivities:
    """Differentiate what second moments grow by with respect to every parameter, and what links lose by.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    """
    with (
        part("sensitivities"),
        single_threaded(),
        finite_equations(system.origin.topology),
        np.errstate(all="ignore"),
    ):
        free = [*varied(system), *_of_channels(system)]
        if why := _too_many(len(free)) or _not_varied(here := growth(system, prepared)):
            return Sensitivities(0.0, (), (), f"what moves it most: not looked for: {why}")
        rows, without = [], []
        for item in free:
            present = value_now(system, item)
            try:
                slope = _derivative(system, item, present, prepared)
            except ApcError:  # not even so near can it be judged
                slope = None
            if slope is None:
                without.append(item.label)
                continue
            unit = unit_of(system, item.name)
            rows.append(Sensitivity(item.label, unit, present, slope, slope * present, 0))
    rows.sort(key=lambda row: (-abs(row.relative), row.parameter))
    note = "by differences of two steps"
    if without:
        note += f"; not differentiated: {', '.join(without)}"
    return Sensitivities(here.radius, ((complex(here.radius), MOMENTS),), tuple(rows), note)


def _derivative(system: CompiledSystem, free: Free, present: float, prepared: Prepared) -> float | None:
    """Return the derivative of what second moments grow by, None where no step fits.

    See the head of this module.
    """
    low, high = allowed(system, free)
    step = STEP * abs(present)
    if not step or not (low <= present - step and present + step <= high):
        return None

    def at(value: float) -> float:
        overrides = [Override(free, Fraction(value))]
        return growth_at(system, prepared, overrides, PLACE, bounded=False).radius

    widths = [(present + width) - present for width in (step, step / 2)]
    coarse, fine = ((at(present + width) - at(present - width)) / (2 * width) for width in widths)
    return (4 * fine - coarse) / 3
