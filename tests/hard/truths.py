"""The truth about every scene here, to fifty digits: `python -m tests.hard.truths` writes truths.json.

All peers (equal ones by a representative and the weights of its class) are followed event by event in ball
arithmetic, see `tests.fifty_digits`; two precisions agree on every digit written. Nothing of the analysis
takes part. A delay of a thousand frames comes as a polynomial, whose roots Arb encloses.
"""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint

from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.eigen.balls import precision
from tests.fifty_digits.truth import (
    DIGITS,
    RIGID,
    Truth,
    classes_of,
    eigenvalues,
    frame_matrices,
    spectral_truth,
)

HERE = Path(__file__).resolve().parent
TRUTHS = HERE / "truths.json"

# Below this a pivot of M − 1, of entries of 1 or more, is none: at 1024 bits its rounding is 1e-300.
NO_PIVOT = 1e-60

# Frames of delay up to which packets are states.
MOST_FRAMES = 60


def main() -> None:
    """Write the truths."""
    found = {}
    for path in sorted(HERE.glob("*.yaml")):
        found[path.stem] = truth_of(compile_topology(path))
        print(
            f"{path.stem:<24} {found[path.stem]['spectral_radius'][:24]}  {found[path.stem]['verdict']}",
            flush=True,
        )
    TRUTHS.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def truth_of(system: CompiledSystem) -> dict[str, Any]:
    """Return the radius (rigid modes left out), how many rigid modes there are, and the verdict."""
    frames = _frames_of_delay(system)
    truth = spectral_truth(system) if frames <= MOST_FRAMES else _by_polynomial(system, frames)
    assert isinstance(truth, Truth), truth
    chains = _chains(system) if frames <= MOST_FRAMES else 0
    if truth.radius > 1:
        verdict = "unstable"
    elif chains:
        verdict = "drifts"
    else:
        verdict = "stable up to a common translation" if truth.rigid else "stable"
    return {"spectral_radius": truth.digits, "rigid_modes": truth.rigid - chains, "verdict": verdict}


def _frames_of_delay(system: CompiledSystem) -> int:
    seconds = {timing.name: timing.value for timing in system.timings}
    period = {clock.name: seconds[clock.period] for clock in system.clocks}
    return max(int(seconds[link.delay] / period[link.clock]) for link in system.links)


def _chains(system: CompiledSystem) -> int:
    """Return how many of the eigenvalues 1 have no vector of their own that stands still."""
    missing = 0
    with precision(1024):
        for _, count, matrix in frame_matrices(system, classes_of(system)):
            n = matrix.nrows()
            held = sum(float(abs(value - 1).mid()) < RIGID for value in eigenvalues(matrix))
            rows = [[matrix[i, j].mid() - (i == j) for j in range(n)] for i in range(n)]
            missing += count * (held - (n - _rank(rows)) if held else 0)
    return missing


def _rank(rows: list[list[Any]]) -> int:
    """Return the rank by Gaussian elimination with the largest pivot of all."""
    rank, places = 0, list(range(len(rows)))
    rows = [list(row) for row in rows]
    while places:
        size, r, c = max(
            ((float(abs(rows[r][c])), r, c) for r in range(rank, len(rows)) for c in places),
            key=lambda one: one[0],
        )
        if size < NO_PIVOT:
            break
        rows[rank], rows[r] = rows[r], rows[rank]
        for row in rows[rank + 1 :]:
            factor = row[c] / rows[rank][c]
            for place in places:
                row[place] = (row[place] - factor * rows[rank][place]).mid()
        places.remove(c)
        rank += 1
    return rank


def _by_polynomial(system: CompiledSystem, frames: int) -> Truth:
    """Return the truth of equal peers on one link of at most two channels and a delay of many whole frames.

    With one frame of delay the map is z⁺ = P z + Q s[k − 1], s = S z; with d frames its eigenvalues are the
    zeros of det(z − P − z^(−d) Q S) = p₀(z) + z^(−d) p₁(z) + z^(−2d) p₂(z), after multiplying with z^(2d).
    """
    [link] = system.links
    near, nearest = (
        _delayed(system, link.delay, Fraction(1, frames)),
        _delayed(system, link.delay, Fraction(0)),
    )
    roots: list[Any] = []
    radius, rigid = flint.arb(0), 0
    with precision(1024):
        half = flint.arb(flint.fmpq(1, 2))
        both = zip(*(frame_matrices(one, classes_of(one)) for one in (near, nearest)), strict=True)
        for (_, count, matrix), (_, _, without) in both:
            core = without.nrows()
            channels = matrix.nrows() - core
            p = flint.arb_mat([[matrix[i, j] for j in range(core)] for i in range(core)])
            q = flint.arb_mat([[matrix[i, core + j] for j in range(channels)] for i in range(core)])
            s = flint.arb_mat([[matrix[core + i, j] for j in range(core)] for i in range(channels)])
            at = [flint.arb_poly((p + q * s * w).charpoly()) for w in (-1, 0, 1)]
            p_0, p_1, p_2 = at[1], (at[2] - at[0]) * half, (at[2] + at[0]) * half - at[1]
            whole = _shifted(p_0, 2 * frames) + _shifted(p_1, frames) + p_2
            coefficients = [one.mid() for one in whole.coeffs()]
            while coefficients[0].is_zero():  # p₂ is zero where one channel alone is heard
                coefficients.pop(0)
            found = [root.mid() for root in _roots(coefficients)]
            for value in found:
                if float(abs(value - 1).mid()) < RIGID:
                    rigid += count
                else:
                    radius = max(radius, abs(value).mid())
            roots += found
    return Truth(radius, rigid, tuple(roots))


def _delayed(system: CompiledSystem, name: str, factor: Fraction) -> CompiledSystem:
    """Return the scene with a timing multiplied."""
    timings = tuple(
        replace(one, value=one.value * factor) if one.name == name else one for one in system.timings
    )
    return replace(system, timings=timings)


def _shifted(polynomial: Any, by: int) -> Any:
    return flint.arb_poly([flint.arb(0)] * by + list(polynomial.coeffs()))


def _roots(coefficients: list[Any]) -> list[Any]:
    """Return all roots, enclosed apart."""
    return list(flint.acb_poly(coefficients).roots(tol=flint.arb(10) ** (-DIGITS - 10), maxprec=8192))


if __name__ == "__main__":
    main()
