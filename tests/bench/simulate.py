# ruff: noqa: E501 -- tables are printed by long lines
"""How right and how fast `apc simulate` is: `python -m tests.bench.simulate`.

Errors stand beside times. A time is the best of a few runs in a warm process, after compiling; a ratio compares with a
loop over the same events in NumPy, or with time itself.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import expm

from apc.runtime.analysis.analysis import analyze, lifted_groups
from apc.runtime.eigen.modes import dense
from apc.runtime.simulate.blocks import blocks
from apc.runtime.simulate.simulation import prepare
from apc.runtime.simulate.trajectory import simulate
from apc.runtime.threads import single_threaded
from tests.eventwise import experiment, play
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

MOVED = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, 0 mm]}}"))
REPEATS = 7


def best(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the seconds of the fastest of some runs."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def against_frame_map() -> None:
    """10 s of the linear scene against powers of the analysis' map of all peers."""
    system = compiled(MOVED)
    closed = dense(*lifted_groups(system))
    state = np.zeros(len(closed.names))
    state[closed.motion[0]] = 0.01
    rows = [state]
    for _ in range(1250):
        rows.append(closed.matrix @ rows[-1])
    expected = np.array(rows)[:, list(closed.motion)]
    found = simulate(system, duration=Fraction(10), signals=["device.*", "cube.*"]).values[::8]
    error = np.abs(found - expected).max() / np.abs(expected).max()
    print(f"10 s against powers of the frame map      relative {error:.1e}   target 1e-12")


def against_events() -> None:
    """The experiment's scenes against stepping them by hand."""
    for name, operator in (("average", "mean"), ("mesh", "sum")):
        text = (SCENES / f"experiment-{name}.yaml").read_text(encoding="utf-8")
        found = simulate(compiled(text))
        expected = np.array(play(experiment(operator), Fraction(3)))[:, 1:].reshape(-1, 3, 6)
        expected[:, 0, 4] *= -1
        apart = np.abs(found.values.reshape(-1, 3, 6) - expected)
        same = ((found.values.reshape(-1, 3, 6)[:, :, 4] > 0) == (expected[:, :, 4] > 0)).all()
        states = "contact states agree throughout" if same else "contact states differ at some tick"
        print(
            f"experiment-{name:<8} event by event by hand   {apart[:, :, :4].max():.1e} m, m/s, "
            f"{apart[:, :, 4:].max():.1e} N   target 1e-9   {states}: {found.summary.verdict}"
        )


def growth() -> None:
    """The growth of an unstable run against the spectral radius."""
    system = compiled(replaced(MOVED, ("stiffness: 500 N/m", "stiffness: 1400 N/m")))
    found = simulate(system, duration=Fraction(16), signals=["cube.v"])
    size = np.linalg.norm(found.values[::8], axis=1)
    grown = (size[-100:].max() / size[-1100:-1000].max()) ** 1e-3
    radius = analyze(system, method="dense").spectral_radius
    print(
        f"growth of an unstable run a frame         {grown:.6f}, spectral radius {radius:.6f}, relative {abs(grown / radius - 1):.1e}"
    )


def drag() -> None:
    """The drag of a moved cube against the viscosity formula."""
    for text, name, added in ((AVERAGE, "average", 2.3), (MESH, "mesh", 4.6)):
        hand = "hands: {hand: {type: ConstantForce, flange: device, force: 1 N}}\nstudies:"
        text = replaced(text, ("stiffness: 500 N/m", "stiffness: 200 N/m"), ("studies:", hand))
        found = simulate(compiled(text), duration=Fraction(4), signals=["cube.x"])
        speed = (found.values[-1, 0] - found.values[-81, 0]) / 0.080
        got = 1 / speed - 10
        print(
            f"drag of a moved cube, {name:<8}            {got:.6f} N·s/m, formula {added}, relative {abs(got / added - 1):.1e}   target 1e-3"
        )


def numpy_loop(ticks: int) -> np.ndarray:
    """Play the three-user scene in NumPy, all users at once, a tick at a time; return (ticks, 3, 6)."""
    kc, kt, h = 1000.0, 500.0, 1e-3
    a = np.zeros((4, 4))
    a[0, 1] = a[2, 3] = 1
    a[1, 1], a[3, 3] = -50.0, -25.0
    b = np.zeros((4, 2))
    b[1, 0], b[3, 0], b[3, 1] = -10.0, 5.0, -5.0
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * h)
    e, f = both[:4, :4].T, both[:4, 4:].T
    x = np.zeros((3, 4))
    x[0, 0] = 0.01
    force, acting = np.zeros((3, 2)), np.zeros((3, 2))
    sent, heard = np.zeros(3), np.zeros(3)
    rows = np.empty((ticks, 3, 6))
    for k in range(ticks):
        rows[k, :, :4] = x
        rows[k, :, 4:] = force
        if k % 8 == 0:
            heard, sent = sent, x[:, 2].copy()
        acting = force
        others = (heard.sum() - heard) / 2
        force = np.stack([kc * (x[:, 0] - x[:, 2]), kt * (x[:, 2] - others)], axis=1)
        x = x @ e + acting @ f
    return rows


def speed() -> None:
    """10 s of the three-user scene, every signal recorded."""
    system = compiled(MOVED)
    began = time.perf_counter()
    found = simulate(system, duration=Fraction(10))
    first = time.perf_counter() - began
    loop = best(lambda: numpy_loop(10_001), 3)
    kept = [i for i, one in enumerate(found.signals) if not one.local.endswith(" acting")]
    error = np.abs(found.values[:, kept].reshape(-1, 3, 6) - numpy_loop(10_001)).max()
    print(
        f"\n10 s of three users, 10,000 ticks, {len(found.signals)} signals (with preparing, not compiled before or found again: {first:.2f} s)"
    )
    print(f"  NumPy loop         {1e3 * loop:8.2f} ms   differs by {error:.1e}")
    for name, jit in (("virtual machine", False), ("machine code", True)):
        ready = prepare(system, Fraction(10), jit=jit)
        taken = best(lambda ready=ready: list(blocks(ready)))  # type: ignore[misc]
        print(
            f"  {name:<16}   {1e3 * taken:8.2f} ms   {taken / loop:6.4f} of the NumPy loop   target 10 ms, 0.2"
        )


def crowds(numbers: list[int]) -> None:
    """Many equal peers at 1 kHz, one of them recorded."""
    print("\nequal peers, forces every 1 ms, one peer recorded, one core")
    for number in numbers:
        seconds = Fraction(1) if number <= 10**4 else Fraction(1, 10)
        system = compiled(replaced(AVERAGE, ("{count: 3}", f"{{count: {number}, set: {{device.x: 1 mm}}}}")))
        began = time.perf_counter()
        ready = prepare(system, seconds, signals=["user[1].*"])
        prepared = time.perf_counter() - began
        taken = best(lambda ready=ready: list(blocks(ready)), 2)  # type: ignore[misc]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(
            f"  {number:>7} peers   {taken / float(seconds):8.3f} of real time   prepared in {prepared:5.2f} s   process at most {peak:.2f} GiB so far"
        )


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.simulate", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="leave out the largest crowd")
    quick = parser.parse_args().quick
    with single_threaded():
        against_frame_map()
        against_events()
        growth()
        drag()
        speed()
        crowds([100, 1000, 10**4] if quick else [100, 1000, 10**4, 10**5])


if __name__ == "__main__":
    main()
