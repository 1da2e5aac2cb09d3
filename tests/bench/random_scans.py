"""Random scans of a parameter or delay against a fine grid: `python -m tests.bench.random_scans`.

Stiffnesses and delays are scanned in topologies with clocks, delays and gains at random. The truth is
the matrix of all peers (see `tests.bruteforce`), whose eigenvalues are looked at on a grid and on either side
of every crossing that is claimed: none may be invented or missed.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np

import apc
from apc.support.threads import single_threaded
from apc.verdict import ProofMethod
from tests.bench.by_hand import Floats
from tests.bench.judge import decided, parser_of
from tests.bruteforce import TopologySource, frame_matrices
from tests.topologies import compiled
from tests.truths import text_of

# A radius nearer to 1 than this tells no side: the rounding of some fifty eigenvalues in floats.
UNSURE = 1e-10

# How far beside a claimed crossing, relatively, its sides are looked at.
ALONGSIDE = 1e-5

# Points of the grid over a parameter, and over a delay, whose every value is a schedule of its own.
GRID, DELAYS = 400, 24

# Scans that could not clear every cell, and crossings that were not proved: an eigenvalue that follows the
# circle is a draw's luck.
MOST_OPEN = 2e-2


# What is scanned, and what `TopologySource` calls it.
_FIELDS = {
    "contact.stiffness": "kc",
    "coordination.stiffness": "kt",
    "contact.delay": "contact_comp",
    "coordination.delay": "comp",
    "lan.delay": "comm",
}


@dataclass(frozen=True)
class Draw:
    """A scan: the topology, and what varies in it; a delay's values are looked at one by one."""

    topology: TopologySource
    name: str

    @property
    def present(self) -> float:
        """The value that the topology has."""
        return float(getattr(self.topology, _FIELDS[self.name]))

    @property
    def grid(self) -> Floats:
        """Values from next to nothing to far beyond the present one; no delay at which events coincide."""
        if self.name.endswith("delay"):
            longest = max(self.present, float(self.topology.haptic)) * 3
            return longest * (np.arange(DELAYS) + np.pi / 8) / DELAYS
        wide = np.geomspace(1e-9 * self.present, 900 * self.present, GRID // 2)
        return np.concatenate([wide, np.linspace(0, 6 * self.present, GRID // 2)[1:]])

    def radii(self, values: Floats) -> Floats:
        """Return the largest magnitude of any motion but the common translation, at values (k,)."""
        field = _FIELDS[self.name]
        if self.name.endswith("delay"):
            times = [Fraction(float(one)) for one in values]
            frames = [frame_matrices(replace(self.topology, **{field: one}), 1)[0] for one in times]
        else:
            frames = [*frame_matrices(replace(self.topology, **{field: values}), len(values))]
        listed = [np.linalg.eigvals(one) for one in frames]
        return np.array([np.abs(np.delete(one, np.argmin(np.abs(one - 1)))).max() for one in listed])


def draw(generator: random.Random) -> Draw:
    """Return a scan at random."""
    pick, ms = generator.choice, Fraction(1, 1000)

    def decades(low: float, high: float) -> float:
        return float(f"{10 ** generator.uniform(low, high):.3g}")

    tick = ms * pick([Fraction(1), Fraction(1), Fraction(1, 2), Fraction(2)])
    period = tick * pick([1, 2, 4, 4, Fraction(5, 2)])
    late, contact = (pick([Fraction(0), tick, tick, ms * generator.randint(1, 250) / 100]) for _ in range(2))
    topology = TopologySource(
        operator=pick(["mean", "sum"]),
        peers=generator.randint(2, 3),
        kt=decades(1.5, 3.3),
        bt=pick([0.0, decades(-1, 1)]),
        kc=decades(2, 3.5),
        bc=pick([0.0, decades(-1, 1)]),
        comp=late,
        contact_comp=contact,
        comm=pick([Fraction(0), period, period, 2 * period, ms * generator.randint(1, 1500) / 100]),
        own_delay=generator.random() < 0.6,
        haptic=tick,
        network=period,
    )
    return Draw(topology, pick([*_FIELDS]))


def check(scan: Draw, found: apc.Critical) -> str:
    """Return what is wrong with a scan, "" if nothing is."""
    low, high = found.searched_to
    if not low <= scan.present <= high:
        return f"the present value {scan.present!r} is not in what was scanned, {found.searched_to}"
    edges = np.array([one.value for one in found.crossings])
    errors = np.array([one.error for one in found.crossings])
    aside = ALONGSIDE * np.abs(edges) + 2 * errors
    points = np.concatenate([scan.grid, edges - aside, edges + aside])
    points = points[(points > low) & (points < high)]
    # Nearer to a crossing than its error nothing is claimed; nearer to another than the cell, neither.
    apart = np.abs(points[:, None] - edges[None]).min(axis=1, initial=np.inf)
    points = points[apart > 1.5 * errors.max(initial=0.0)]
    radius = scan.radii(points)
    sides = [bool(found.verdict and found.verdict.stable)]
    if found.crossings:
        sides = [found.crossings[0].stable_side == "below"]
        sides += [one.stable_side == "above" for one in found.crossings]
    claimed = np.array(sides)[np.searchsorted(edges, points)]
    for place in np.flatnonzero((np.abs(radius - 1) > UNSURE) & (claimed != (radius < 1))):
        side = "stable" if claimed[place] else "unstable"
        return f"{side} at {points[place]!r}, radius {radius[place]!r}; crossings {edges.tolist()}"
    return ""


@dataclass
class Tally:
    """What came out: `open` scans have an eigenvalue that follows the circle."""

    scans: int = 0
    crossings: int = 0
    estimated: int = 0
    open: int = 0
    wrong: list[str] = field(default_factory=list)


def run(points: int, *, seed: int = 0) -> Tally:
    """Scan so many random topologies, of a seed."""
    generator, tally = random.Random(seed), Tally()
    with single_threaded():
        for _ in range(points):
            scan = draw(generator)
            text = text_of(scan.topology)
            tally.scans += 1
            try:
                found = apc.critical(compiled(text), scan.name)
                fault = check(scan, found)
            except (apc.ApcError, AssertionError, ArithmeticError, IndexError, ValueError) as error:
                tally.wrong.append(f"{scan.name}: {error!r}\n{text}")
                continue
            tally.crossings += len(found.crossings)
            tally.estimated += sum(one.proof.method is ProofMethod.ESTIMATED for one in found.crossings)
            tally.open += not found.complete
            tally.wrong += [f"{scan.name}: {fault}\n{text}"] if fault else []
    return tally


def main() -> None:
    """Print what came out, and every scan that is wrong."""
    parser = parser_of("random_scans", __doc__)
    parser.add_argument("--count", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    with decided(parser) as (judge, given):
        tally = run(40 if given.quick else given.count, seed=given.seed)
        print(replace(tally, wrong=[]))
        for one in tally.wrong:
            judge.right(one, holds=False)
        judge.within("crossings without a proof", tally.estimated, MOST_OPEN * tally.crossings)
        judge.within("scans left open", tally.open, MOST_OPEN * tally.scans)


if __name__ == "__main__":
    main()
