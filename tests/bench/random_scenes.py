# ruff: noqa: E501 -- scenes are written by long lines
"""Random scenes, each verdict and bound against 256-bit arithmetic: `python -m tests.bench.random_scenes`.

Graphs, clocks, delays, groups and couplings are drawn, and for each such structure numbers over many decades.
The truth comes from the compiled functions alone, event by event (see `bench.reference`). A bound that does
not hold and a wrong verdict must be none, verdicts left open and scenes refused hardly any.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial

import flint

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.runtime.analysis.analysis import Analysis, analyze
from apc.runtime.bench.reference import RIGID, classes_of, eigenvalues, frame_matrices
from apc.runtime.bench.timing import timed
from apc.runtime.eigen.balls import precision
from apc.runtime.frame.overrides import Override, apply
from apc.runtime.threads import single_threaded
from tests.bench.judge import Judge, parser_of
from tests.topologies import compiled

BITS = 256  # a chain of four equal eigenvalues still keeps 19 digits
DRAWS = 20  # of numbers for each structure

# Shares of all scenes. Left open: gains drawn over decades come no nearer to a boundary than floats tell, and
# what is on one by its structure (no damping, no coupling) balls decide; one in a thousand is a draw's luck.
MOST_UNDECIDED = 1e-3
# Refused as beyond floats: a tick of 2 ms drives 1e-4 kg on 1e5 N/m apart 1e4-fold at most, and a frame has
# 20 ticks at most: 1e80, which is a float. None should be refused; one in a thousand is a draw's luck.
MOST_REFUSED = 1e-3


def structure(generator: random.Random) -> str:
    """Return a topology at random."""
    pick = generator.choice
    tick = pick(["1 ms", "0.5 ms", "2 ms", "4/3 ms"])
    ratio = pick(["1 ms", "2 ms", "4 ms", "8 ms", "8 ms", "2.5 ms", "10 ms"])
    delay = pick(["0 s", "1 ms", "1.5 ms", "1/3 ms"])
    late = pick(
        ["0 s", "1 ms", "7/3 ms", ratio, ratio, "8 ms" if Fraction(ratio.split()[0]) < 4 else "20 ms"]
    )
    peers = generator.randint(2, 5)
    groups = f"user: {{count: {peers}}}"
    if generator.random() < 0.3:
        groups = f"one: {{count: {generator.randint(1, 2)}, set: {{device.mass: 0.37 kg}}}}\n  two: {{count: {peers}}}"
        peers = 0
    graph = pick(["", "", "", ", graph: ring", ", graph: star", "arcs"])
    if graph and peers:
        peers = min(peers, 3)  # their truth is that of all peers as one matrix
        groups = f"user: {{count: {peers}}}"
    if graph == "arcs":
        graph = _arcs(generator, peers) if peers else ""
    arm = ""
    if generator.random() < 0.4:
        arm = "hands:\n  arm: {type: SpringDamperArm, flange: device, stiffness: 80 N/m, damping: 1 N*s/m}\n"
    coupling = pick(["AveragePosition", "FullMesh"])
    return (
        f"topology: random\nclocks: {{haptic: {tick}, network: {ratio}}}\npeers:\n  {groups}\n"
        "masses:\n  device: {mass: 0.1 kg, damping: 5 N*s/m}\n"
        "  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}\n"
        "couplers:\n"
        f"  contact: {{type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: {delay}}}\n"
        f"  coordination: {{type: {coupling}, object: cube, stiffness: 500 N/m, clock: haptic, delay: {delay}, link: lan}}\n"
        f"links:\n  lan: {{clock: network, delay: {late}{graph}}}\n{arm}"
    )


def _arcs(generator: random.Random, peers: int) -> str:
    """Return arcs with weights in which everybody hears somebody."""
    arcs = []
    for receiver in range(1, peers + 1):
        others = [one for one in range(1, peers + 1) if one != receiver]
        for sender in generator.sample(others, generator.randint(1, len(others))):
            arcs.append(f"[{sender}, {receiver}, {generator.choice([1, 1, 0.5, 2])}]")  # noqa: PERF401 -- two loops
    return f", graph: {{arcs: [{', '.join(arcs)}]}}"


def numbers(generator: random.Random) -> list[Override]:
    """Return numbers at random: a decade is as likely as the next."""

    def decades(low: float, high: float, *, zero: float = 0.0) -> Fraction:
        return Fraction(0) if generator.random() < zero else Fraction(10 ** generator.uniform(low, high))

    found = {
        "device.mass": decades(-4, 1),
        "device.damping": decades(-6, 2, zero=0.1),
        "cube.mass": decades(-4, 1),
        "cube.damping": decades(-6, 2, zero=0.1),
        "contact.stiffness": decades(-1, 5, zero=0.05),
        "contact.damping": decades(-3, 1.5, zero=0.4),
        "coordination.stiffness": decades(-1, 4, zero=0.05),
        "coordination.damping": decades(-3, 1.5, zero=0.4),
    }
    return [Override(name, None, Fraction(float(value))) for name, value in found.items()]


@dataclass
class Tally:
    """What came out."""

    scenes: int = 0
    refused: int = 0
    undecided: int = 0
    proved: int = 0
    seconds: float = 0.0
    tightest: float = 0.0  # the largest error ÷ bound
    verdicts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """Return a few lines."""
        each = 1e3 * self.seconds / max(self.scenes, 1)
        share = 100 / max(self.scenes + self.refused, 1)
        words = ", ".join(f"{count} {name}" for name, count in sorted(self.verdicts.items()))
        return (
            f"{self.scenes} analyses: {words}\n{len(self.wrong)} wrong, {self.undecided} undecided ({share * self.undecided:.2g} %), "
            f"{self.proved} proved in balls, {self.refused} beyond floats ({share * self.refused:.2g} %); error/bound at most "
            f"{self.tightest:.2g}; {each:.1f} ms an analysis"
        )


def truth(system: CompiledSystem) -> tuple[flint.arb, int]:
    """Return the radius without eigenvalues that are 1, and how many these are (a drift counts twice)."""
    radius, rigid = flint.arb(0), 0
    for _, count, matrix in frame_matrices(system, classes_of(system)):
        for value in eigenvalues(matrix):
            if float(abs(value - 1).mid()) < RIGID:
                rigid += count
            else:
                radius = max(radius, abs(value).mid())
    return radius, rigid


def check(found: Analysis, radius: flint.arb, rigid: int) -> str:
    """Return what is wrong with an analysis, "" if nothing is."""
    apart = abs(
        radius - flint.arb(found.spectral_radius)
    ).mid()  # 256 bits: no rounding that floats could see
    if not apart <= flint.arb(found.spectral_radius_error) or not math.isfinite(found.spectral_radius_error):
        return f"radius {found.spectral_radius} ± {found.spectral_radius_error}, truth {radius.str(20)}"
    if found.stable is None:
        return ""
    if found.verdict == "drifts":
        return "" if radius < 1 and rigid > found.rigid_modes else "it does not drift"
    if found.stable != bool(radius < 1):
        return f"{found.verdict}, truth {radius.str(20)}"
    return (
        "" if found.rigid_modes == rigid or not found.stable else f"{found.rigid_modes} rigid, truth {rigid}"
    )


def run(points: int, *, seed: int = 0, methods: Sequence[str] = ("auto",), draws: int = DRAWS) -> Tally:
    """Analyse so many random scenes by each method.

    Parameters
    ----------
    points
        How many.
    seed
        Of what is drawn.
    methods
        See `analysis.analyze`.
    draws
        Of numbers for each structure.
    """
    generator, tally = random.Random(seed), Tally()
    with single_threaded(), precision(BITS):
        for number in range(points):
            if number % draws == 0:
                text = structure(generator)
                plain = compiled(text)
            drawn = numbers(generator)
            system = apply(plain, drawn)
            known = None
            for method in methods:
                values = ", ".join(f"{one.name}={float(one.value)!r}" for one in drawn)
                try:
                    taken, found = timed(partial(analyze, system, method=method))
                except ApcError as error:
                    assert error.mistakes[0].code in ("E806", "E850"), error
                    tally.refused += 1
                    continue
                except Exception as error:  # whatever it is, it is a bug
                    tally.wrong.append(f"{method}: {error!r}\n{text}{values}")
                    continue
                tally.seconds += taken
                known = known or truth(system)
                tally.scenes += 1
                tally.undecided += found.stable is None
                tally.proved += bool(found.proof)
                tally.verdicts[found.verdict.partition(":")[0]] += 1
                off = float(abs(known[0] - flint.arb(found.spectral_radius)).mid())
                if found.spectral_radius_error:
                    tally.tightest = max(tally.tightest, off / found.spectral_radius_error)
                wrong = check(found, *known)
                if wrong:
                    tally.wrong.append(f"{method}: {wrong}\n{text}{values}")
    return tally


def main() -> None:
    """Print what came out, and every scene that is wrong."""
    parser = parser_of("random_scenes", __doc__)
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--methods", default="auto", help="auto,dense,determinant,krylov")
    given = parser.parse_args()
    judge = Judge(given.strict)
    tally = run(given.points, seed=given.seed, methods=given.methods.split(","))
    print(tally)
    for one in tally.wrong:
        judge.right(one, holds=False)
    most = tally.scenes + tally.refused
    judge.within("verdicts left open", tally.undecided, MOST_UNDECIDED * most)
    judge.within("scenes beyond floats", tally.refused, MOST_REFUSED * most)
    judge.end()


if __name__ == "__main__":
    main()
