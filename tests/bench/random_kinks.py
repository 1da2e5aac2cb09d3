"""`python -m tests.bench.random_kinks --count 1000 --seed 1`: starts on, before and behind kinks.

A mass carries a sampled force, piecewise linear in its position and velocity: a random expression of
max, min, abs and if. An independent program moves a little in many directions from the start, takes slopes
of the force there by differences, and steps the mass exactly. The exit code is 1 unless all sides agree.
"""

from __future__ import annotations

import argparse
import math
import random
import tempfile
from pathlib import Path

import numpy as np

import apc
from apc.compiler.errors import ApcError
from tests.language.own import component
from tests.topologies import compiled, library

MASS, DAMPING, PERIOD = 1.0, 20.0, 1e-3
DIRECTIONS, STEP, INNER = 400, 1e-6, 1e-9


def expression(rng: random.Random, depth: int) -> tuple[str, str]:
    """Return a force in newtons of z = x/m and w = v·s/m, as Python reads it and as apc does."""
    if depth == 0:
        leaf = rng.choice(
            ("30000*z", "-9000*z", "60000*z", "15*w", "-5*w", "60000*z + 8*w", "20000*(z - 0.001)", "0")
        )
        return leaf, leaf
    (one, this), (other, that) = expression(rng, depth - 1), expression(rng, depth - 1)
    form = rng.choice(("max({}, {})", "min({}, {})", "({}) + ({})", "({}) - ({})", "abs", "if"))
    if form == "abs":
        return f"abs({one})", f"abs({this})"
    if form == "if":  # continuous: both branches vanish where the condition changes
        return (
            f"((({one}) if ({one}) > 0 else 0.25*({one})))",
            f"(if ({this}) > 0 then ({this}) else 0.25*({this}))",
        )
    return form.format(one, other), form.format(this, that)


def radius(stiffness: float, gain: float) -> float:
    """Return the spectral radius of the mass with the force stiffness·x + gain·v held over a period."""
    rate = DAMPING / MASS
    decay = math.exp(-rate * PERIOD)
    reach = (1 - decay) / rate
    push = np.array([[(PERIOD - reach) / DAMPING], [(1 - decay) / DAMPING]])
    values = np.linalg.eigvals(np.array([[1.0, reach], [0.0, decay]]) - push @ [[stiffness, gain]])
    if abs(stiffness) < 1e-3:  # nothing holds the position
        values = np.delete(values, np.argmin(abs(values - 1)))
        if abs(values - 1).min() < 1e-6:
            return math.nan  # nor slows it: it drifts
    return float(abs(values).max())


def sides_by_hand(text: str, x: float) -> set[tuple[float, float]]:
    """Return the slopes of the force over position and velocity on each side of the start."""
    code = compile(text, "force", "eval")

    def force(position: float, velocity: float) -> float:
        return float(eval(code, {"max": max, "min": min, "abs": abs}, {"z": position, "w": velocity}))

    rng = np.random.default_rng(0)
    found = set()
    for angle in rng.uniform(0, 2 * math.pi, DIRECTIONS):
        # 20 kN/m and 5 N·s/m turn steps of these sizes into forces of one size.
        a, b = x + STEP * math.cos(angle), STEP * 3e3 * math.sin(angle)
        slopes = (
            (force(a + INNER, b) - force(a - INNER, b)) / (2 * INNER),
            (force(a, b + INNER) - force(a, b - INNER)) / (2 * INNER),
        )
        found.add((round(slopes[0], 2), round(slopes[1], 3)))
    return found


def model(python: str, text: str, x: float, folder: Path) -> apc.Model:
    """Return the compiled topology."""
    z, w = "sample(flange.x)/L", "sample(der(flange.x))*T/L"
    force = text.replace("z", f"({z})").replace("w", f"({w})")
    part = component(f"f = F*({force})", "flange.f = hold(f)", variables="f=N")
    return compiled(
        "topology: kink\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        f"masses: {{device: {{mass: {MASS} kg, damping: {DAMPING} N*s/m, x: {x!r} m}}}}\n"
        "couplers: {own: {type: Own, flange: device, clock: tick}}\n",
        library(folder, part),
    )


def compare(rng: random.Random, folder: Path) -> str:
    """Return what is wrong with one topology, "" if all agrees, "refused" if apc refuses it."""
    python, text = expression(rng, rng.randrange(1, 4))
    while "z" not in text and "w" not in text:
        python, text = expression(rng, rng.randrange(1, 4))
    x = rng.choice((0.0, 0.0, 0.0, 1e-3, -1e-3))
    by_hand = sides_by_hand(python, x)
    truths = sorted({round(radius(*slopes), 10) for slopes in by_hand})
    if any(map(math.isnan, truths)):
        return ""
    try:
        found = apc.analyze(model(python, text, x, folder))
    except ApcError as error:
        return "refused" if error.mistakes[0].code == "E808" else f"{error}"
    sides = {round(side.spectral_radius, 10) for side in found.sides} or {round(found.spectral_radius, 10)}
    agree = abs(found.spectral_radius - truths[-1]) < 1e-6 and all(
        any(abs(side - truth) < 1e-6 for truth in truths) for side in sides
    )
    return "" if agree else f"{text} at {x}: {found.spectral_radius} of {sorted(sides)}, by hand {truths}"


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.random_kinks", description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    wrong = refused = 0
    for _ in range(options.count):
        with tempfile.TemporaryDirectory() as folder:
            reported = compare(rng, Path(folder))
        refused += reported == "refused"
        if reported not in ("", "refused"):
            wrong += 1
            print(reported)
    print(f"{options.count} topologies: {wrong} wrong, {refused} refused (E808)")
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
