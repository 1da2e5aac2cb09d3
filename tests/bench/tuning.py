"""Gains that do best, beside differential evolution on a grid of scenarios: value, what is violated, time.

What is violated is counted by brute force afterwards: a dense grid over all that gains have to bear.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import differential_evolution

import apc
from tests.topologies import AVERAGE, MESH, compiled

K, B, MASS = "coordination.stiffness", "coordination.damping", "device.mass"
FREE = {K: (10.0, 5000.0), B: (0.0, 50.0)}
TOPOLOGIES = {"average": AVERAGE, "mesh": MESH}


def radii(model: apc.Model, spread: float, counts: range, masses: int) -> Callable[..., np.ndarray]:
    """Return what gives the spectral radii (counts, masses) with gains (2,)."""
    mass = {MASS: 0.1 * np.linspace(1 - spread, 1 + spread, masses)}

    def of(gains: np.ndarray) -> np.ndarray:
        at = dict(zip(FREE, map(float, gains), strict=True))
        many = (apc.analyze_many(model, mass, params=at | {"user.count": n}) for n in counts)
        return np.array([one.spectral_radius for one in many])

    return of


def main() -> int:
    """Print one line a question and program; return 1 if gains said to be proved violate anything."""
    print(
        f"{'topology, users, mass':28}{'program':24}{'K, N/m':>10}{'violated':>10}{'points':>8}{'time, s':>9}"
    )
    wrong = 0
    for (name, text), (last, spread) in itertools.product(TOPOLOGIES.items(), ((3, 0.0), (6, 0.2))):
        model, counts = compiled(text), range(3 if last == 3 else 2, last + 1)
        over = {"user.count": f"{counts[0]}:{last}", MASS: f"±{100 * spread:g}%"} if spread else None
        few, dense = (radii(model, spread, counts, masses) for masses in (3, 401))

        def merit(gains: np.ndarray, few: Callable[..., np.ndarray] = few) -> float:
            largest = float(few(gains).max())
            return -float(gains[0]) if largest < 1 else 1e6 * largest

        for program in ("apc tune", "differential evolution"):
            begun = time.perf_counter()
            if program == "apc tune":
                tuned = apc.tune(model, FREE, maximize=K, over=over)
                gains, points = np.array([float(one.value) for one in tuned.gains]), tuned.evaluations
                program += ", proved" * tuned.proved
            else:
                found = differential_evolution(merit, [*FREE.values()], seed=1, maxiter=40, polish=False)
                gains, points = found.x, found.nfev
            used, violated = time.perf_counter() - begun, float((dense(gains) >= 1).mean())
            wrong |= violated > 0 and "proved" in program
            label = f"{name}, {counts[0]} to {last}, ±{100 * spread:g} %"
            print(f"{label:28}{program:24}{gains[0]:10.5g}{100 * violated:8.2g} %{points:8d}{used:9.2f}")
    return int(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
