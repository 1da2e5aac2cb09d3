"""The paper's scene asked of other programs for the same answers: `python -m tests.bench.comparison`.

First the spectral radius of one frame, without the eigenvalue 1 of the common translation:

    apc             compiled before; the analysis alone
    NumPy by hand   SciPy's exponential of one user, a frame of eight ticks, users joined by hand
    modes by hand   by an expert: equal users are two modes of one, with participation and a disc for every
                    eigenvalue
    textbook        NumPy by hand with (1 − e^(−bT/m)) m/b instead of an exponential
    python-control  the plants sampled by its `c2d`; it has no systems of several rates, so that the frame is
                    again joined by hand

Where an eigenvalue has to be told from 1 by its distance, as by all but apc, it is the one nearest to 1. Then
the states at every tick while three users' cube swings:

    apc             prepared before; the run alone
    NumPy by hand   a loop over the ticks, all users at once, its steps exact
    Drake, PathSim  see `tests.bench.drake` and `tests.bench.pathsim`: neither knows a spectral radius

Times (of the processor) and errors (against fifty digits) stand side by side. FMPy is left out: it runs
models that another program has exported, and none that could state the scene and export it comes with pip.
"""

from __future__ import annotations

import importlib.util
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np
from scipy.linalg import expm

import apc
from apc.analysis.analysis import analyze
from apc.benchmark.timing import median_time, take_turns
from apc.compiler.compiled import CompiledSystem
from apc.simulation.blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.threads import single_threaded
from tests.bench.drake import played_by_drake
from tests.bench.judge import Judge, parser_of
from tests.bench.paper_scene import (
    CUBE_DAMPING,
    CUBE_MASS,
    DEVICE_DAMPING,
    DEVICE_MASS,
    K_C,
    K_T,
    TICK,
    TICKS,
    USERS,
    Floats,
)
from tests.bench.pathsim import played_by_pathsim
from tests.bench.simulate import MOVED, numpy_loop
from tests.fifty_digits.truth import Truth, exact_course, spectral_truth
from tests.topologies import AVERAGE, compiled

ROUNDS = 15
# Damping of device and cube, in N·s/m: the paper's, and one at which the textbook's form loses its digits.
assert DEVICE_DAMPING == CUBE_DAMPING
DAMPINGS = (DEVICE_DAMPING, 1e-6)
MODES, MOST = "modes by hand", 3.0  # the program that answers as much, and what of its time apc may take
SECONDS = 1  # that are played
# Most that a state may be off, in m and m/s: of 1000 ticks each rounds states of at most 1 by 1e-16, which
# all in one direction are 1e-13; ten times that is no rounding.
ROUNDED = 1e-12
# By its name: what is installed for it, and the tolerances asked of it after the one it comes with.
SIMULATORS = {
    "Drake": ("pydrake", "drake", played_by_drake, (None, 1e-8)),
    "PathSim": ("pathsim", "pathsim", played_by_pathsim, (None, 1e-10)),
}
WHOLE = "apc's time is that of the whole answer:\nevery mode and its shape, and a bound on its error\n"
WITHOUT = "FMPy is left out: what it runs another program has to export,\nand none that can comes with pip"


@dataclass(frozen=True, slots=True)
class Row:
    """A program: its median `seconds`, its error, and what it says itself that this is at most."""

    seconds: float
    error: float
    bound: float | None = None

    def told(self, unit: str) -> tuple[float, str]:
        """Return the seconds, and the error in words."""
        most = "" if self.bound is None else f" ≤ {self.bound:.1e}"
        return self.seconds, f"{self.error:.1e}{most}{unit}"


def by_exponential(mass: float, damping: float) -> Floats:
    """Return [F G] (2, 3) of a damped mass over a tick."""
    return np.asarray(expm(np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]]) * TICK)[:2])


def by_textbook(mass: float, damping: float) -> Floats:
    """Return the same by the closed form."""
    decay = math.exp(-damping * TICK / mass)
    rise = (1 - decay) / damping
    return np.array([[1, mass * rise, (TICK - mass * rise) / damping], [0, decay, rise]])


def by_control(mass: float, damping: float) -> Floats:
    """Return the same by python-control."""
    import control

    plant = control.ss([[0, 1], [0, -damping / mass]], [[0], [1 / mass]], np.eye(2), np.zeros((2, 1)))
    sampled = control.c2d(plant, TICK, "zoh")
    return np.hstack([sampled.A, sampled.B])


def one_user(step: Callable[[float, float], Floats], damping: float) -> tuple[Floats, Floats]:
    """Return a tick over (x, v, x_O, v_O, F_C, F_T, packet), and what of the packets of others it hears."""
    device, cube = step(DEVICE_MASS, damping), step(CUBE_MASS, damping)
    tick = np.zeros((7, 7))
    tick[:2, :2], tick[:2, 4] = device[:, :2], -device[:, 2]
    tick[2:4, 2:4], tick[2:4, 4], tick[2:4, 5] = cube[:, :2], cube[:, 2], -cube[:, 2]
    tick[4, [0, 2]] = K_C, -K_C
    tick[5, 2] = K_T
    tick[6, 6] = 1
    hears = np.zeros((7, 7))
    hears[5, 6] = -K_T
    return tick, hears


def modes_by_hand(damping: float) -> tuple[list[Floats], list[Floats], float]:
    """Return the participation and the discs of each mode's eigenvalues, and the spectral radius."""
    tick, hears = one_user(by_exponential, damping)
    shares, discs, sizes = [], [], []
    for weight in (1.0, -1 / (USERS - 1)):  # all alike, and apart
        frame = np.linalg.matrix_power(tick + weight * hears, TICKS)
        frame[6] = [0, 0, 1, 0, 0, 0, 0]
        values, vectors = np.linalg.eig(frame)
        inverse = np.linalg.inv(vectors)
        shares.append(np.abs(inverse.T * vectors))
        rounded = np.finfo(float).eps * len(frame) * np.abs(inverse) @ np.abs(frame) @ np.abs(vectors)
        off = np.abs(inverse @ frame @ vectors - np.diag(values))
        discs.append((off + rounded).sum(axis=1))  # Gershgorin's
        sizes.append(np.abs(values))
        if weight == 1:  # that of all moving together is 1
            sizes[0][np.argmin(np.abs(values - 1))] = 0
    return shares, discs, float(np.max(sizes))


def radius(step: Callable[[float, float], Floats], damping: float) -> float:
    """Return the spectral radius of a frame of all users."""
    tick, hears = one_user(step, damping)
    mean = (np.ones((USERS, USERS)) - np.eye(USERS)) / (USERS - 1)
    fast = np.kron(np.eye(USERS), tick) + np.kron(mean, hears)
    frame = np.linalg.matrix_power(fast, TICKS)
    for user in range(USERS):  # the packet of the frame's start is heard in the next
        frame[7 * user + 6] = 0
        frame[7 * user + 6, 7 * user + 2] = 1
    values = np.linalg.eigvals(frame)
    return float(np.abs(np.delete(values, np.argmin(np.abs(values - 1)))).max())


def compare(damping: float, rounds: int = ROUNDS) -> dict[str, Row]:
    """Return what each program takes and is off by, all taking turns.

    "apc" is asked about other numbers each time, and for all modes.
    """
    system = scene(damping)
    truth = spectral_truth(system)
    assert isinstance(truth, Truth)
    others = iter([system, system, *_others(system, 2 * rounds)])  # the first of either is that of the truth
    calls: dict[str, Callable[[], float]] = {
        "apc": lambda: _answered(next(others)),
        "apc, again": lambda: _answered(system),
        "apc, no modes": lambda: analyze(next(others)).spectral_radius,
        "NumPy by hand": lambda: radius(by_exponential, damping),
        MODES: lambda: modes_by_hand(damping)[-1],
        "textbook": lambda: radius(by_textbook, damping),
    }
    if importlib.util.find_spec("control"):
        calls["python-control"] = lambda: radius(by_control, damping)
    found = {name: call() for name, call in calls.items()}
    with single_threaded():
        times = take_turns(calls, rounds)
    exact = Fraction(truth.digits)
    bounds = {"apc": analyze(system).spectral_radius_error}
    return {
        name: Row(statistics.median(times[name]), float(abs(Fraction(found[name]) - exact)), bounds.get(name))
        for name in calls
    }


def _answered(system: CompiledSystem) -> float:
    """Return the spectral radius, with all modes looked at."""
    found = analyze(system)
    assert len(found.modes)
    return found.spectral_radius


def _others(system: CompiledSystem, count: int) -> Iterator[CompiledSystem]:
    """Yield the scene with numbers that nobody analysed before."""
    for number in range(1, count + 1):
        yield apc.set_parameters(system, {"coordination.stiffness": f"{K_T * (1 + 1e-6 * number)!r} N/m"})


def scene(damping: float) -> CompiledSystem:
    """Return the paper's scene with another damping of device and cube."""
    value = f"{damping!r} N*s/m"
    return apc.set_parameters(compiled(AVERAGE), {"device.damping": value, "cube.damping": value})


def play(rounds: int = ROUNDS) -> dict[str, Row]:
    """Return what each program takes and its largest error of a state, in m and m/s; others play once."""
    system = compiled(MOVED)
    truth = exact_course(system, Fraction(SECONDS))
    assert not isinstance(truth, str), truth
    ready = prepare(system, Settings(Fraction(SECONDS)), signals=["*.x", "*.v"])
    ticks = round(SECONDS / TICK) + 1
    calls: dict[str, Callable[[], Floats]] = {
        "apc": partial(_rows, ready),
        "NumPy by hand": lambda: numpy_loop(ticks)[:, :, :4].reshape(ticks, -1),
    }
    found: dict[str, Row] = {}
    with single_threaded():
        for name, call in calls.items():
            taken, rows = median_time(call, rounds)
            bound = ROUNDED if name == "apc" else None
            found[name] = Row(taken, float(np.abs(rows - truth[1]).max()), bound)
        for name, (module, _, played, tolerances) in SIMULATORS.items():
            for tolerance in tolerances if importlib.util.find_spec(module) else ():
                rows, taken = played(float(SECONDS), tolerance)
                title = name if tolerance is None else f"{name}, {tolerance:g}"
                found[title] = Row(taken, float(np.abs(rows - truth[1]).max()))
    return found


def _rows(ready: Simulation) -> Floats:
    return np.concatenate([block.values for block in blocks(ready)])


def show(title: str, table: dict[str, Row], judge: Judge, unit: str = "") -> None:
    """Print a table of times and errors, and judge those that come with a bound."""
    print(f"{title}\n\n  program              median      ratio      error")
    for name, row in table.items():
        said = "" if row.bound is None else judge.within(f"{name}, {title}", row.error, row.bound)
        ratio = row.seconds / table["apc"].seconds
        print(f"  {name:<16} {1e3 * row.seconds:8.3f} ms {ratio:10.3f} {row.error:10.1e}  {said}".rstrip())
        if not name.startswith("apc"):
            judge.beside(title, table["apc"].told(unit), name, row.told(unit))
    print()


def main() -> None:
    """Print a table for each question, and who is left out."""
    judge = Judge(parser_of("comparison", __doc__).parse_args().strict)
    for damping in DAMPINGS:
        title, found = f"spectral radius of the paper's scene, damping {damping:g} N·s/m", compare(damping)
        show(title, found, judge)
        ratio = found["apc"].seconds / found[MODES].seconds
        print(f"  apc / {MODES} {ratio:.2f}, target {MOST:g} {judge.in_time(title, ratio, MOST)}\n")
    print(WHOLE)
    show(f"12 states of three users at every tick of {SECONDS} s", play(), judge, " m, m/s")
    packages = {"python-control": ("control", "control")}
    packages |= {name: (module, package) for name, (module, package, *_) in SIMULATORS.items()}
    for name, (module, package) in packages.items():
        if not importlib.util.find_spec(module):
            print(f"{name} is left out: it is not installed (pip install {package})")
    print(WITHOUT)
    judge.end()


if __name__ == "__main__":
    main()
