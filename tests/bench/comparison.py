"""The paper's topology asked of other programs for the same answers: `python -m tests.bench.comparison`.

First the spectral radius of one frame, without the eigenvalue 1 of the common translation:

    apc             compiled before; the analysis alone, of numbers it was not asked before
    NumPy by hand   SciPy's exponential of one user, a frame of eight ticks, users joined by hand
    modes by hand   by an expert: equal users are two modes of one, with participation and a disc for every
                    eigenvalue

Where an eigenvalue has to be told from 1 by its distance, as by all but apc, it is the one nearest to 1. Then
the states at every tick while three users' cube swings, by apc, prepared before, by a loop in NumPy whose
steps are exact, and by PathSim. Last 10,000 points of the stiffnesses at once, beside a program of two modes.

Times (of the processor) and errors (against fifty digits) stand side by side. A program that is not installed
is left out.
"""

from __future__ import annotations

import importlib.util
import statistics
from collections.abc import Callable
from fractions import Fraction
from functools import partial

import numpy as np

import apc
from apc.benchmark.timing import alternate, median_time
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from tests.bench.by_hand import (
    DEVICE_DAMPING,
    K_T,
    START,
    TICK,
    Floats,
    by_pathsim,
    modal_radii,
    mode_radius,
    numpy_loop,
    radius,
)
from tests.bench.judge import Judge, Timed, decided, parser_of
from tests.fifty_digits.truth import Truth, exact_course, spectral_truth
from tests.paper_limit import truth
from tests.topologies import AVERAGE, compiled, replaced

ROUNDS = 15
# Damping of device and cube, in N·s/m: the paper's, and one at which the textbook's form loses its digits.
DAMPINGS = (DEVICE_DAMPING, 1e-6)
SECONDS = 1  # that are played
# Most that a state may be off, in m and m/s: of 1000 ticks each rounds states of at most 1 by 1e-16, which
# all in one direction are 1e-13; ten times that is no rounding.
ROUNDED = 1e-12
SIDE, KNOWN = 100, 200  # points of the map, and those whose truth is computed
MOVED = replaced(AVERAGE, ("{count: 3}", f"{{count: 3, set: {{device.x: [{START} m, 0 m, 0 m]}}}}"))


def radii(judge: Judge, damping: float, rounds: int) -> None:
    """Compare the spectral radius of one topology."""
    value = f"{damping!r} N*s/m"
    model = apc.set_parameters(compiled(AVERAGE), {"device.damping": value, "cube.damping": value})
    exact = spectral_truth(model)
    assert isinstance(exact, Truth)
    stiffnesses = (f"{K_T * (1 + 1e-6 * number)!r} N/m" for number in range(1, 3 * rounds))
    others = (apc.set_parameters(model, {"coordination.stiffness": one}) for one in stiffnesses)
    first = apc.analyze(model)
    calls: dict[str, Callable[[], float]] = {
        "apc": lambda: apc.analyze(next(others)).spectral_radius,
        "NumPy by hand": lambda: radius(damping),
        "modes by hand": lambda: mode_radius(damping),
    }
    values = {name: call() for name, call in calls.items()} | {"apc": first.spectral_radius}
    times = alternate(calls, rounds)
    bounds = {"apc": first.spectral_radius_error}
    off = {name: float(abs(Fraction(one) - Fraction(exact.digits))) for name, one in values.items()}
    rows = [Timed(name, statistics.median(times[name]), off[name], bounds.get(name)) for name in calls]
    title = f"spectral radius of the paper's topology, damping {damping:g} N·s/m"
    judge.table(title, rows, most={"modes by hand": 3.0})


def play(judge: Judge, rounds: int) -> None:
    """Compare the states at every tick."""
    model = compiled(MOVED)
    exact = exact_course(model, Fraction(SECONDS))
    assert not isinstance(exact, str), exact
    ready = prepare(model, Settings(Fraction(SECONDS)), signals=["*.x", "*.v"])
    ticks = round(SECONDS / TICK) + 1
    runs = {
        "apc": median_time(partial(rows_of, ready), rounds),
        "NumPy by hand": median_time(lambda: numpy_loop(ticks)[:, :, :4].reshape(ticks, -1), 3),
    }
    if importlib.util.find_spec("pathsim") is None:
        print("PathSim is left out: pip install pathsim")
    else:
        runs["PathSim"] = by_pathsim(SECONDS, None)
        runs["PathSim, 1e-10"] = by_pathsim(SECONDS, 1e-10)
    programs = [
        Timed(name, seconds, float(np.abs(rows - exact[1]).max()), ROUNDED if name == "apc" else None)
        for name, (seconds, rows) in runs.items()
    ]
    judge.table(f"12 states of three users at every tick of {SECONDS} s", programs, unit=" m, m/s")


def rows_of(ready: Simulation) -> Floats:
    """Return the rows of a run that is prepared."""
    return np.concatenate([block.values for block in blocks(ready)])


def many(judge: Judge, rounds: int) -> None:
    """Compare 10,000 points at once with the batched program of two modes."""
    k_c, k_t = (one.ravel() for one in np.meshgrid(*[np.linspace(10.0, 3000.0, SIDE)] * 2))
    given = {"contact.stiffness": k_c, "coordination.stiffness": k_t}
    model = compiled(AVERAGE)
    calls = {"ours": lambda: apc.analyze_many(model, given), "theirs": lambda: modal_radii(k_c, k_t)}
    results = apc.analyze_many(model, given)
    naive = modal_radii(k_c, k_t)
    times = alternate(calls, rounds)
    some = np.random.default_rng(1).choice(len(k_c), KNOWN, replace=False)
    exact = np.array([float(truth(False, float(k_c[one]), float(k_t[one]), 0.0).radius) for one in some])
    off = np.abs(results.spectral_radius[some] - exact)
    judge.within("many at once: error / bound", float((off / results.spectral_radius_error[some]).max()), 1)
    ours, theirs = (statistics.median(times[name]) for name in calls)
    wrong = f"; {int((results.stable != (naive < 1)).sum())} verdicts differ"
    rows = [
        Timed("apc", ours, float(off.max()), float(results.spectral_radius_error.max())),
        Timed(
            "NumPy, two modes, all points at once",
            theirs,
            float(np.abs(naive[some] - exact).max()),
            None,
            wrong,
        ),
    ]
    title = f"{SIDE**2:,} points: verdict, radius, modes"
    judge.table(title, rows, most={rows[1].program: 1.0})


def main() -> None:
    """Print a table for each question."""
    with decided(parser_of("comparison", __doc__)) as (judge, given):
        rounds = 5 if given.quick else ROUNDS
        for damping in DAMPINGS:
            radii(judge, damping, rounds)
        play(judge, rounds)
        many(judge, 3 if given.quick else 9)


if __name__ == "__main__":
    main()
