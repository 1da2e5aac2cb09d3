"""Exact boundary curves against the obvious program, error beside time: `python -m tests.bench.region`.

The obvious program decides a grid of 100 × 100 points of the paper's scene by max |λ| < 1. Times are CPU
seconds in a warm process, from a compiled model to curves. Errors are against 50 digits
(`tests.paper_limit`).
"""

from __future__ import annotations

import statistics
from functools import partial

import numpy as np

from apc.benchmark.timing import take_turns, timed
from apc.frame.overrides import apply, parse_override
from apc.regions.axes import parse_axes
from apc.regions.boundary import relative_to
from apc.regions.curves import between
from apc.regions.region import Region, region
from tests.bench.by_hand import modal_radii, stable_grid
from tests.bench.judge import Judge, Timed, judged, parser_of
from tests.paper_limit import limit
from tests.topologies import AVERAGE, MESH, compiled

LOW, HIGH, COUNT = 10.0, 3000.0, 100
X = f"contact.stiffness={LOW} N/m:{HIGH} N/m"
Y = f"coordination.stiffness={LOW} N/m:{HIGH} N/m"

# For factors of curves: where these are steep, an error across is a larger one in height.
SPANS = (("contact", 5000), ("coordination", 9000))
FINE = 1e-12
# Of proportional coordination the mesh's gain counts (N − 1) times, for every delay: the factor is 2. Curves
# that are right to FINE across are so to this in height, where they are steeper than 1 in 1,000 at most.
PROPORTIONAL = "Fig. 3, B = 0"
FACTOR, FACTOR_ERROR = 2.0, 1e-8


def true_error(found: Region, every: int) -> float:
    """Return the curves' largest distance from the boundary in 50 digits, relative as their `error` is."""
    worst = 0.0
    low, width = found.rectangle.low, found.rectangle.width
    for curve in found.curves:
        knots = (curve.points - low) / width
        normal = np.stack([curve.tangents[:-1, 1], -curve.tangents[:-1, 0]], axis=1)
        for share in (0.0, 0.25, 0.5, 0.75):
            places = between(knots[:-1], knots[1:], curve.tangents[:-1], curve.tangents[1:], share)[1::every]
            values = found.rectangle.values(places)
            away = values[:, 1] - [limit(float(x), float(y)) for x, y in values]
            away = np.abs(away) / width[1] * np.abs(normal[1::every, 1])
            worst = max(worst, float((away / relative_to(places, normal[1::every], low / width)).max()))
    return worst


def paper(judge: Judge, quick: bool) -> None:
    """Time the paper's boundary against the obvious program, and two modes of all points at once."""
    system = compiled(AVERAGE)
    axes = parse_axes(system, X, Y)
    first, curves = timed(lambda: region(system, axes))
    points = np.meshgrid(*[np.linspace(LOW, HIGH, COUNT)] * 2)
    modal = partial(modal_radii, *(one.ravel() for one in points))
    calls = {"exact": lambda: region(system, axes), "modal": modal}
    times = take_turns(calls, 5 if quick else 15)
    exact, at_once = (statistics.median(times[name]) for name in calls)
    missed = int(np.sum(curves.contains(*points).ravel() != (modal() < 1)))
    count = 30 if quick else COUNT
    taken, stable = timed(partial(stable_grid, LOW, HIGH, count))
    truth = curves.contains(*np.meshgrid(*[np.linspace(LOW, HIGH, count)] * 2))
    obvious, modes = (
        f"obvious program, {COUNT} × {COUNT} points",
        f"two modes at once, {COUNT} × {COUNT} points",
    )
    programs = [
        Timed("apc", exact, true_error(curves, 40 if quick else 7), curves.curves[0].error),
        Timed("apc, the first time", first),
        Timed(
            obvious,
            taken * (COUNT / count) ** 2,
            None,
            None,
            f"{np.sum(truth != stable)} of {count**2} points wrong",
        ),
        Timed(modes, at_once, None, None, f"{missed} of {COUNT**2} points wrong"),
    ]
    title = f"boundary curves of K_C, K_T, {LOW:.0f} to {HIGH:.0f} N/m"
    judge.table(title, programs, most_s=6e-3, most={obvious: 1 / 50, modes: 1 / 20})


def crossing(found: Region, x: float) -> float | None:
    """Return the highest stable y over x, None where there is none."""
    heights = []
    for curve in found.curves:
        knots = (curve.points - found.rectangle.low) / found.rectangle.width
        over = np.flatnonzero((curve.points[:-1, 0] - x) * (curve.points[1:, 0] - x) <= 0)
        for place in over[:1]:
            ends = [one[place : place + 1] for one in (knots, knots[1:], curve.tangents, curve.tangents[1:])]
            low, high = 0.0, 1.0
            rising = curve.points[place + 1, 0] > x
            for _ in range(60):
                middle = (low + high) / 2
                value = found.rectangle.values(between(*ends, middle))[0]
                low, high = (low, middle) if (value[0] > x) == rising else (middle, high)
            heights.append(float(value[1]))
    return max(heights, default=None)


def factors(judge: Judge) -> None:
    """Print how much more gain the mean allows than the sum, along the curves of Figs. 3 and 4."""
    delays = {
        "(a) no delay": ("contact.delay=0 ms", "coordination.delay=0 ms", "lan.delay=0 ms"),
        "(b) both delays": ("contact.delay=1 ms", "coordination.delay=1 ms", "lan.delay=8 ms"),
    }
    print("\nlargest K_T of the mean over that of the sum, along the curves")
    for figure, damping in ((PROPORTIONAL, "0 N*s/m"), ("Fig. 4, B = 2", "2 N*s/m")):
        for panel, settings in delays.items():
            texts = [f"{name}.damping={damping}" for name in ("contact", "coordination")] + list(settings)
            found = []
            for text in (AVERAGE, MESH):
                system = compiled(text)
                system = apply(system, [parse_override(system, one) for one in texts])
                wide = [f"{name}.stiffness=0 N/m:{high} N/m" for name, high in SPANS]
                found.append(region(system, parse_axes(system, *wide), tolerance=FINE))
            ratios = {}
            for x in np.linspace(25, 4975, 199).tolist():
                mean, total = (crossing(one, x) for one in found)
                if mean is not None and total is not None:
                    ratios[x] = mean / total
            low, high = min(ratios.values()), max(ratios.values())
            first = next((x for x, ratio in ratios.items() if ratio <= 1), None)
            note = f", at most 1 from K_C = {first:.0f} N/m on" if first else ""
            if figure == PROPORTIONAL:
                judge.within(f"factor, {figure} {panel}", max(FACTOR - low, high - FACTOR), FACTOR_ERROR)
            print(f"  {figure} {panel:<16} {low:.10f} to {high:.10f} ({len(ratios)} values of K_C{note})")


def main() -> None:
    """Print the tables."""
    with judged(parser_of("region", __doc__)) as (judge, given):
        paper(judge, given.quick)
        factors(judge)


if __name__ == "__main__":
    main()
