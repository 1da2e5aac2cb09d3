"""Gains that do best, beside differential evolution on a grid of scenarios: value, what is violated, time.

What is violated is counted by brute force afterwards: a dense grid over all that gains have to bear.
"""

from __future__ import annotations

import itertools
import time

import numpy as np
from scipy.optimize import differential_evolution

import apc
from tests.topologies import AVERAGE, MESH, compiled

K, B, MASS = "coordination.stiffness", "coordination.damping", "device.mass"
FREE = {K: (10.0, 5000.0), B: (0.0, 50.0)}
SCENES = {"average": AVERAGE, "mesh": MESH}


def violated(model: apc.CompiledSystem, gains: dict[str, float], counts: range, spread: float) -> float:
    """Return the share of 401 masses with each number of peers at which gains are not stable."""
    masses = {MASS: 0.1 * np.linspace(1 - spread, 1 + spread, 401)}
    bad = [apc.analyze_many(model, masses, set=gains | {"user.count": n}).stable for n in counts]
    return float(np.mean([~one.astype(bool) for one in bad]))


def evolved(model: apc.CompiledSystem, counts: range, spread: float) -> tuple[dict[str, float], int]:
    """Return the stiffest gains that SciPy finds on the middle and the ends of the ranges, and its points."""
    masses = {MASS: 0.1 * np.array([1 - spread, 1.0, 1 + spread])}
    looked = 0

    def merit(gains: np.ndarray) -> float:
        nonlocal looked
        looked += 1
        at = dict(zip(FREE, gains.tolist(), strict=True))
        radii = [
            apc.analyze_many(model, masses, set=at | {"user.count": n}).spectral_radius.max() for n in counts
        ]
        return -float(gains[0]) if max(radii) < 1 - 1e-12 else 1e6 * max(radii)

    found = differential_evolution(merit, list(FREE.values()), seed=1, maxiter=40, polish=False)
    return dict(zip(FREE, found.x.tolist(), strict=True)), looked


def main() -> int:
    """Print one line a question and program; return 1 if gains said to be proved violate anything."""
    print(f"{'scene, users, mass':28}{'program':24}{'K, N/m':>10}{'violated':>10}{'points':>8}{'time, s':>9}")
    wrong = 0
    for (name, text), (last, spread) in itertools.product(SCENES.items(), ((3, 0.0), (6, 0.2))):
        model, counts = compiled(text), range(3 if last == 3 else 2, last + 1)
        over = {"user.count": f"{counts[0]}:{last}", MASS: f"±{100 * spread:g}%"} if spread else None
        begun = time.perf_counter()
        tuned = apc.tune(model, FREE, maximize=K, over=over)
        taken = time.perf_counter() - begun
        typed = {one.parameter: float(one.value) for one in tuned.gains}
        share = violated(model, typed, counts, spread)
        wrong |= tuned.proved and share > 0
        begun = time.perf_counter()
        other, points = evolved(model, counts, spread)
        rows = (
            ("apc tune, proved" if tuned.proved else "apc tune", typed, share, tuned.looked, taken),
            (
                "differential evolution",
                other,
                violated(model, other, counts, spread),
                points,
                time.perf_counter() - begun,
            ),
        )
        for program, gains, bad, looked, seconds in rows:
            label = f"{name}, {counts[0]} to {last}, ±{100 * spread:g} %"
            print(f"{label:28}{program:24}{gains[K]:10.5g}{100 * bad:8.2g} %{looked:8d}{seconds:9.2f}")
    return int(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
