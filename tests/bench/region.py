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
from apc.regions.axes import parse_axes
from apc.regions.boundary import relative_to
from apc.regions.curves import between, tangents
from apc.regions.region import Region, region
from tests.bench.by_hand import modal_radii, stable_grid
from tests.bench.judge import Judge, Timed, judged, parser_of
from tests.paper_limit import limit
from tests.topologies import AVERAGE, compiled

LOW, HIGH, COUNT = 10.0, 3000.0, 100
X = f"contact.stiffness={LOW} N/m:{HIGH} N/m"
Y = f"coordination.stiffness={LOW} N/m:{HIGH} N/m"


def true_error(found: Region, every: int) -> float:
    """Return the curves' largest distance from the boundary in 50 digits, relative as their `error` is."""
    worst = 0.0
    low, width = found.rectangle.low, found.rectangle.width
    for curve in found.curves:
        knots = (curve.points - low) / width
        handles = (curve.handles - low) / width
        normal = tangents(knots, handles)[:-1, ::-1] * [1, -1]
        for share in (0.0, 0.25, 0.5, 0.75):
            places = between(knots, handles, share)[1::every]
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


def main() -> None:
    """Print the table."""
    with judged(parser_of("region", __doc__)) as (judge, given):
        paper(judge, given.quick)


if __name__ == "__main__":
    main()
