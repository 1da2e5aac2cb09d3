# ruff: noqa: E501 -- tables are printed by long lines
"""The map of the paper's scene over K_C and K_T, every verdict against 60 digits: `python -m tests.bench.map`.

Four maps: P (no damping in the couplers) and PD (2 N·s/m), mean and mesh; then the points at the boundary of
each column times 1 ± 1e-9; before them 10,000 points at once beside a batched program by hand. Wrong verdicts must be none; an error beside its bound must be below 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from statistics import median

import flint
import numpy as np

from apc.analysis.analysis import Prepared, analyze, prepare
from apc.benchmark.timing import timed
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import precision
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.threads import single_threaded
from apc.vary.many import analyze_many
from tests.bench.judge import Judge, parser_of
from tests.bench.naive_region import modal_radii
from tests.bench.paper_scene import CUBE_DAMPING, DEVICE_DAMPING, DEVICE_MASS, SHARED_MASS, TICKS, USERS
from tests.bruteforce import Scene, as_ball, frame_matrix
from tests.topologies import AVERAGE, MESH, compiled

SIDE = 100  # of the map that is made at once
BITS = 200  # of precision: 60 decimal digits
CERTAIN = 1e-40  # so far, and no more, the truth itself may be off (`check_truth`)
MOST_K_C, MOST_K_T = 5000.0, 1500.0  # the limits of the scene's own study; with dampers, twice that holds
MS = Fraction(1, 1000)
DEVICE, CUBE = Fraction(DEVICE_MASS), Fraction(SHARED_MASS) / USERS  # the numbers a compiled scene holds


@dataclass(frozen=True)
class Truth:
    """All eigenvalues of a point, and the radius without the one that is 1."""

    values: list[flint.acb]
    radius: flint.arb


def truth(mesh: bool, k_c: float, k_t: float, damping: float) -> Truth:
    """Return the truth at a point, by propagating one user who hears its own packets times an eigenvalue of W."""
    own = 2 if mesh else 1
    values: list[flint.acb] = []
    radius = flint.arb(0)
    for share, rigid in ((flint.arb(own), True), (-flint.arb(own) / 2, False)):
        matrix = _frame(own, share, flint.arb(k_c), flint.arb(k_t), flint.arb(damping))
        found = flint.acb_mat(flint.arb_mat(matrix).mid()).eig(algorithm="approx")
        found.sort(key=lambda value: float(abs(value - 1).mid()))
        values += found
        assert not rigid or float(abs(found[0] - 1).mid()) < CERTAIN
        radius = max([radius, *(abs(value).mid() for value in found[1 if rigid else 0 :])])
    return Truth(values, radius)


def _frame(
    own: int, share: flint.arb, k_c: flint.arb, k_t: flint.arb, damping: flint.arb
) -> list[list[flint.arb]]:
    """Return one user's frame over (x, v, x_O, v_O, F_C, F_T, packet x_O, packet v_O), as rows."""
    steps = [_step(DEVICE, DEVICE_DAMPING), _step(CUBE, CUBE_DAMPING)]
    columns = []
    for column in range(8):
        x, v, x_o, v_o, f_c, f_t, p_x, p_v = (flint.arb(int(column == row)) for row in range(8))
        sent = x_o, v_o
        heard = share * (k_t * p_x + damping * p_v)
        for _ in range(TICKS):
            contact = k_c * (x - x_o) + damping * (v - v_o)
            pull = own * (k_t * x_o + damping * v_o) - heard
            x, v = _coast(steps[0], x, v, -f_c)
            x_o, v_o = _coast(steps[1], x_o, v_o, f_c - f_t)
            f_c, f_t = contact, pull
        columns.append((x, v, x_o, v_o, f_c, f_t, *sent))
    return [list(row) for row in zip(*columns, strict=True)]


def _step(kilograms: Fraction, damping: float) -> tuple[flint.arb, ...]:
    """Return what of x and v a millisecond leaves and what a force adds to them."""
    mass, t = as_ball(kilograms), as_ball(MS)
    b = flint.arb(damping)
    decay = (-b * t / mass).exp()
    rise = (1 - decay) / b  # ∫₀ᵗ e^(−b s/m)/m ds
    return decay, rise, mass * rise, (t - mass * rise) / b


def _coast(
    step: Sequence[flint.arb], x: flint.arb, v: flint.arb, force: flint.arb
) -> tuple[flint.arb, flint.arb]:
    decay, rise, carried, pushed = step
    return x + carried * v + pushed * force, decay * v + rise * force


def check_truth() -> None:
    """Assert that the truth of one user is that of three, event by event."""
    for mesh in (False, True):
        scene = Scene(operator="sum" if mesh else "mean", kc=1500.0, kt=800.0, bt=2.0, bc=2.0, cube=CUBE)  # type: ignore[arg-type] # any number will do
        rows = frame_matrix(scene, number=as_ball, exp=lambda value: value.exp())
        whole = flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")
        whole.sort(key=lambda value: float(abs(value - 1).mid()))
        radius = max(abs(value).mid() for value in whole[1:])
        assert float(abs(radius - truth(mesh, 1500.0, 800.0, 2.0).radius)) < CERTAIN


@dataclass
class Tally:
    """What came out of some points."""

    points: int = 0
    wrong: int = 0
    undecided: int = 0
    proved: int = 0
    seconds: float = 0.0
    radius: float = 0.0  # the worst error of the radius beside its bound
    mode: float = 0.0  # and of an eigenvalue
    bound: float = 0.0

    def add(self, system: CompiledSystem, shared: Prepared, values: dict[str, float], known: Truth) -> None:
        """Analyse a point and compare."""
        drawn = [Override(Free(name), Fraction(value)) for name, value in values.items()]
        taken, found = timed(lambda: analyze(apply(system, drawn), prepared=shared))
        self.seconds += taken
        self.points += 1
        self.undecided += found.stable is None
        self.wrong += found.stable is not None and found.stable != bool(known.radius < 1)
        self.proved += bool(found.proof)
        off = float(abs(known.radius - flint.arb(found.spectral_radius)).mid())
        self.radius = max(self.radius, _beside(off, found.spectral_radius_error))
        self.bound = max(self.bound, found.spectral_radius_error)
        for mode in found.modes:
            place = flint.acb(mode.eigenvalue.real, mode.eigenvalue.imag)
            distance = min(float(abs(place - value).mid()) for value in known.values)
            self.mode = max(self.mode, _beside(distance, mode.error))

    def __str__(self) -> str:
        each = 1e3 * self.seconds / max(self.points, 1)
        return (
            f"{self.points:6} points  {self.wrong} wrong  {self.undecided} undecided  {self.proved} proved in balls  "
            f"error/bound {self.radius:.2g} (radius) {self.mode:.2g} (modes)  largest bound {self.bound:.1e}  {each:.1f} ms a point"
        )


def _beside(error: float, bound: float) -> float:
    """Return error ÷ bound; a bound that says nothing is as bad as one that does not hold."""
    if not math.isfinite(bound):
        return math.inf
    if error <= CERTAIN:  # of an eigenvalue that is exactly 0 the analysis knows it, the truth 100 digits
        return 0.0
    return error / bound if bound else math.inf


def one_map(text: str, mesh: bool, damping: float, side: int) -> tuple[Tally, Tally]:
    """Compare a map of side² points, and the points next to its boundary."""
    system = compiled(text)
    shared = prepare(system)
    inner, edge = Tally(), Tally()
    grid = (np.arange(side) + 1) / side
    most = 2 * MOST_K_T if damping else MOST_K_T

    def values(k_c: float, k_t: float) -> dict[str, float]:
        return {
            "contact.stiffness": k_c,
            "coordination.stiffness": k_t,
            "contact.damping": damping,
            "coordination.damping": damping,
        }

    for k_c in (grid * MOST_K_C).tolist():
        stable = []
        for k_t in (grid * most).tolist():
            known = truth(mesh, k_c, k_t, damping)
            stable.append(bool(known.radius < 1))
            inner.add(system, shared, values(k_c, k_t), known)
        for place in np.flatnonzero(np.diff(stable)).tolist():
            low, high = (float(grid[place + more] * most) for more in (0, 1))
            while high - low > 1e-12 * high:
                middle = (low + high) / 2
                same = bool(truth(mesh, k_c, middle, damping).radius < 1) == stable[place]
                low, high = (middle, high) if same else (low, middle)
            for k_t in (low * (1 - 1e-9), low * (1 + 1e-9)):
                edge.add(system, shared, values(k_c, k_t), truth(mesh, k_c, k_t, damping))
    return inner, edge


def at_once(judge: Judge, rounds: int) -> None:
    """Compare 10,000 points at once with the batched modal program, error beside time."""
    grid = np.linspace(10.0, 3000.0, SIDE)
    k_c, k_t = (one.ravel() for one in np.meshgrid(grid, grid))
    given = {"contact.stiffness": k_c, "coordination.stiffness": k_t}
    system = compiled(AVERAGE)
    times = []
    for _ in range(rounds + 1):  # in turn, as the machine is not always as fast; the first is warm-up
        ours, found = timed(lambda: analyze_many(system, given))
        theirs, radii = timed(lambda: modal_radii(k_c, k_t))
        times.append((ours, theirs))
    ours, theirs = (median(one) for one in zip(*times[1:], strict=True))
    some = np.random.default_rng(1).choice(len(k_c), 200, replace=False)
    known = [float(truth(False, float(k_c[place]), float(k_t[place]), 0.0).radius) for place in some]
    off, naive = (float(np.abs(one[some] - known).max()) for one in (found.spectral_radius, radii))
    bound = float(found.spectral_radius_error.max())
    beside = float((np.abs(found.spectral_radius[some] - known) / found.spectral_radius_error[some]).max())
    wrong = int((found.stable != (radii < 1)).sum())
    print(f"{len(k_c):,} points of the mean at once, K_C and K_T in 10 to 3000 N/m")
    print(
        f"  apc.analyze_many      {1e3 * ours:7.0f} ms   error {off:.1e}, bound {bound:.1e}, proved verdicts, modes"
    )
    print(
        f"  batched modal program {1e3 * theirs:7.0f} ms   error {naive:.1e}, no bound; verdicts that differ: {wrong}"
    )
    print(f"  ratio {ours / theirs:.2f}: {judge.in_time('many at once / modal program', ours / theirs, 1)}")
    judge.within("many at once: error of the radius / bound", beside, 1)
    judge.beside(
        f"{len(k_c):,} points: verdict, radius, modes",
        (ours, f"{off:.1e} ≤ {bound:.1e}"),
        "NumPy, two modes, all points at once",
        (theirs, f"{naive:.1e}"),
    )


def main() -> None:
    """Print one line a map."""
    parser = parser_of("map", __doc__)
    parser.add_argument("--points", type=int, default=10_000, help="of all four maps together")
    given = parser.parse_args()
    side = max(2, math.isqrt(given.points // 4))
    judge = Judge(given.strict)
    with single_threaded(), precision(BITS):
        check_truth()
        at_once(judge, 3 if given.points < 1000 else 9)
        for text, mesh in ((AVERAGE, False), (MESH, True)):
            for damping in (0.0, 2.0):
                name = f"{'mesh' if mesh else 'mean'} {'PD' if damping else 'P '}"
                inner, edge = one_map(text, mesh, damping, side)
                print(f"{name}  {inner}")
                print(f"  boundary·(1 ± 1e-9)  {edge}", flush=True)
                for place, tally in ((name, inner), (f"{name} at the boundary", edge)):
                    judge.right(f"{place}: {tally.wrong} verdicts wrong", not tally.wrong)
                    judge.right(f"{place}: {tally.undecided} verdicts left open", not tally.undecided)
                    judge.within(f"{place}: error of the radius / bound", tally.radius, 1)
                    judge.within(f"{place}: error of a mode / bound", tally.mode, 1)
    judge.end()


if __name__ == "__main__":
    main()
