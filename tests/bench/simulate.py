# ruff: noqa: E501 -- tables are printed by long lines
"""How right and how fast `apc simulate` is: `python -m tests.bench.simulate`.

Errors stand beside times. A time is the median of a few runs in a warm process, after compiling; a ratio compares with a
loop over the same events in NumPy, or with time itself.
"""

from __future__ import annotations

import resource
from fractions import Fraction
from functools import partial

import numpy as np
from scipy.linalg import expm

from apc.analysis.analysis import analyze, lifted_groups
from apc.benchmark.timing import median_time, waited
from apc.eigen.modes import dense
from apc.simulation.blocks import Block, blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.trajectory import simulate
from apc.threads import single_threaded
from tests.bench.judge import Judge, parser_of
from tests.bench.paper_scene import (
    CUBE_DAMPING,
    DEVICE_DAMPING,
    FRAME,
    K_C,
    K_T,
    START,
    TICK,
    TICKS,
    USERS,
    Floats,
    user_plant,
)
from tests.eventwise import experiment, play
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

MOVED = replaced(AVERAGE, ("{count: 3}", f"{{count: 3, set: {{device.x: [{START} m, 0 m, 0 m]}}}}"))
REPEATS = 7

# Relative, of 10 s: 10,000 ticks each round by 1e-16, which all in one direction are 1e-12.
LINEAR = 1e-12
# In m, m/s and N, of 3 s: a contact that closes a tick late is 1e-4 m off, roundings are below this.
CONTACTS = 1e-9
# Relative: the largest motion turns by 1.04 rad a frame, so that of the last half turn of a stretch, 3 frames,
# one has cos(0.52) of the whole swing: the largest value is 0.87/1.024³ = 0.81 to 1 of what grows evenly, and
# the thousandth root of a ratio of two such is 2.1e-4 off.
GROWTH = 2.1e-4
# Relative: a delay off by a tick would be 9 %; the formula takes the speed as even within a frame.
DRAG = 1e-3
# Times: ms, and a part of the NumPy loop's.
MOST_MS, MOST_PART = 10.0, 0.2


def against_frame_map(judge: Judge) -> None:
    """10 s of the linear scene against powers of the analysis' map of all peers."""
    system = compiled(MOVED)
    closed = dense(*lifted_groups(system))
    state = np.zeros(len(closed.names))
    state[closed.motion[0]] = START
    rows = [state]
    for _ in range(1250):
        rows.append(closed.matrix @ rows[-1])
    expected = np.array(rows)[:, list(closed.motion)]
    found = simulate(system, duration=Fraction(10), signals=["device.*", "cube.*"]).values[::8]
    error = np.abs(found - expected).max() / np.abs(expected).max()
    print(
        f"10 s against powers of the frame map      relative {error:.1e}   {judge.within('powers of the frame map', error, LINEAR)}"
    )


def against_events(judge: Judge) -> None:
    """The experiment's scenes against stepping them by hand."""
    for name, operator in (("average", "mean"), ("mesh", "sum")):
        text = (SCENES / f"experiment-{name}.yaml").read_text(encoding="utf-8")
        found = simulate(compiled(text))
        expected = np.array(play(experiment(operator), Fraction(3)))[:, 1:].reshape(-1, 3, 6)
        expected[:, 0, 4] *= -1
        apart = np.abs(found.values.reshape(-1, 3, 6) - expected)
        same = bool(((found.values.reshape(-1, 3, 6)[:, :, 4] > 0) == (expected[:, :, 4] > 0)).all())
        said = judge.within(f"experiment-{name} event by event", float(apart.max()), CONTACTS)
        judge.right(f"experiment-{name}: contact states", same)
        states = "contact states agree throughout" if same else "contact states differ at some tick"
        print(
            f"experiment-{name:<8} event by event by hand   {apart[:, :, :4].max():.1e} m, m/s, "
            f"{apart[:, :, 4:].max():.1e} N   {said}   {states}: {found.summary.verdict}"
        )


def growth(judge: Judge) -> None:
    """The growth of an unstable run against the spectral radius."""
    system = compiled(replaced(MOVED, ("stiffness: 500 N/m", "stiffness: 1400 N/m")))
    found = simulate(system, duration=Fraction(16), signals=["cube.v"])
    size = np.linalg.norm(found.values[::8], axis=1)
    grown = (size[-100:].max() / size[-1100:-1000].max()) ** 1e-3
    radius = analyze(system, method="dense").spectral_radius
    off = abs(grown / radius - 1)
    said = judge.within("growth of an unstable run", off, GROWTH)
    print(
        f"growth of an unstable run a frame         {grown:.6f}, spectral radius {radius:.6f}, relative {off:.1e}   {said}"
    )


def drag(judge: Judge) -> None:
    """The drag of a moved cube against the viscosity formula."""
    # K_eff ((T_n − T_c)/2 + T_d): held on average half a frame but a tick, and a frame late.
    late = (FRAME - TICK) / 2 + FRAME
    for text, name, gain in ((AVERAGE, "average", 200.0), (MESH, "mesh", 200.0 * (USERS - 1))):
        added = gain * late
        hand = "hands: {hand: {type: ConstantForce, flange: device, force: 1 N}}\nstudies:"
        text = replaced(text, ("stiffness: 500 N/m", "stiffness: 200 N/m"), ("studies:", hand))
        found = simulate(compiled(text), duration=Fraction(4), signals=["cube.x"])
        speed = (found.values[-1, 0] - found.values[-81, 0]) / 0.080
        got = 1 / speed - DEVICE_DAMPING - CUBE_DAMPING
        off = abs(got / added - 1)
        said = judge.within(f"drag, {name}", off, DRAG)
        print(
            f"drag of a moved cube, {name:<8}            {got:.6f} N·s/m, formula {added:g}, relative {off:.1e}   {said}"
        )


def numpy_loop(ticks: int) -> Floats:
    """Play the three-user scene in NumPy, all users at once, a tick at a time; return (ticks, 3, 6)."""
    a, b = user_plant()
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)
    e, f = both[:4, :4].T, both[:4, 4:].T
    x = np.zeros((USERS, 4))
    x[0, 0] = START
    force, acting = np.zeros((USERS, 2)), np.zeros((USERS, 2))
    sent, heard = np.zeros(USERS), np.zeros(USERS)
    rows = np.empty((ticks, USERS, 6))
    for k in range(ticks):
        rows[k, :, :4] = x
        rows[k, :, 4:] = force
        if k % TICKS == 0:
            heard, sent = sent, x[:, 2].copy()
        acting = force
        others = (heard.sum() - heard) / (USERS - 1)
        force = np.stack([K_C * (x[:, 0] - x[:, 2]), K_T * (x[:, 2] - others)], axis=1)
        x = x @ e + acting @ f
    return rows


def _play(ready: Simulation) -> list[Block]:
    return list(blocks(ready))


def speed(judge: Judge) -> None:
    """10 s of the three-user scene, every signal recorded."""
    system = compiled(MOVED)
    first, found = waited(partial(simulate, system, duration=Fraction(10)))  # a C compiler's time included
    loop, by_hand = median_time(partial(numpy_loop, 10_001), 3)
    kept = [i for i, one in enumerate(found.signals) if not one.local.endswith(" acting")]
    apart = np.abs(found.values[:, kept].reshape(-1, 3, 6) - by_hand).max(axis=(0, 1))
    error = float((apart / np.abs(by_hand).max(axis=(0, 1))).max())
    said = judge.within("against the NumPy loop", error, LINEAR)
    print(
        f"\n10 s of three users, 10,000 ticks, {len(found.signals)} signals (with preparing, not compiled before or found again: {first:.2f} s)"
    )
    print(f"  NumPy loop         {1e3 * loop:8.2f} ms   differs by {error:.1e}, relative   {said}")
    for name, jit in (("virtual machine", False), ("machine code", True)):
        ready = prepare(system, Settings(Fraction(10), jit=jit))
        taken, _ = median_time(partial(_play, ready), REPEATS)
        kept_s = judge.in_time(f"{name}, ms", 1e3 * taken, MOST_MS)
        kept_part = judge.in_time(f"{name}, part of the NumPy loop", taken / loop, MOST_PART)
        print(
            f"  {name:<16}   {1e3 * taken:8.2f} ms   {taken / loop:6.4f} of the NumPy loop   target {MOST_MS:g} ms {kept_s}, {MOST_PART:g} {kept_part}"
        )


def populations(numbers: list[int]) -> None:
    """Many equal peers at 1 kHz, one of them recorded."""
    print("\nequal peers, forces every 1 ms, one peer recorded, one core")
    for number in numbers:
        seconds = Fraction(1) if number <= 10**4 else Fraction(1, 10)
        system = compiled(replaced(AVERAGE, ("{count: 3}", f"{{count: {number}, set: {{device.x: 1 mm}}}}")))
        prepared, ready = waited(partial(prepare, system, Settings(seconds), signals=["user[1].*"]))
        taken, _ = median_time(partial(_play, ready), 3)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(
            f"  {number:>7} peers   {taken / float(seconds):8.3f} of real time   prepared in {prepared:5.2f} s   process at most {peak:.2f} GiB so far"
        )


def main() -> None:
    """Print everything."""
    parser = parser_of("simulate", __doc__)
    parser.add_argument("--quick", action="store_true", help="leave out the largest population")
    given = parser.parse_args()
    judge = Judge(given.strict)
    with single_threaded():
        for check in (against_frame_map, against_events, growth, drag, speed):
            check(judge)
        populations([100, 1000, 10**4] if given.quick else [100, 1000, 10**4, 10**5])
    judge.end()


if __name__ == "__main__":
    main()
