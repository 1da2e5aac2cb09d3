"""Random scans of a parameter or delay against a fine grid: `python -m tests.bench.random_scans`.

Stiffnesses, delays and settings that stiffnesses follow by a narrow bump are scanned in scenes with clocks,
delays and gains at random. The truth is the matrix of all peers (see `tests.bruteforce`), whose eigenvalues
are looked at on a grid and on either side of every crossing that is claimed: none may be invented or missed.
"""

from __future__ import annotations

import random
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np

import apc
from apc.benchmark.timing import timed
from apc.threads import single_threaded
from tests.bench.by_hand import Floats
from tests.bench.judge import judged, parser_of
from tests.bruteforce import Scene, frame_matrices
from tests.topologies import compiled, library, replaced
from tests.truths import text_of

# A radius nearer to 1 than this tells no side: the rounding of some fifty eigenvalues in floats.
UNSURE = 1e-10

# How far beside a claimed crossing, relatively, its sides are looked at.
BESIDE = 1e-5

# Points of the grid over a parameter, and over a delay, whose every value is a schedule of its own.
GRID, DELAYS = 400, 24

# Scans that could not clear every cell, and crossings that were not proved: an eigenvalue that follows the
# circle is a draw's luck.
MOST_OPEN = 2e-2

BUMP = """\
component: Bump
about: A spring and damper whose stiffness has a bump over a setting.
connectors: {a: Flange, b: Flange}
parameters:
  low: {unit: N/m, min: 0}
  high: {unit: N/m}
  setting: {unit: 1, min: 0}
  middle: {unit: 1}
  width: {unit: 1, above: 0}
  damping: {unit: N*s/m, min: 0, default: 0}
  clock: clock
  delay: {unit: s, min: 0, default: 0}
equations:
  - k = low + high/(1 + ((setting - middle)/width)^4)
  - f = k*(sample(a.x) - sample(b.x)) + damping*(sample(der(a.x)) - sample(der(b.x)))
  - a.f = hold(f, delay)
  - b.f = -a.f
"""


@dataclass(frozen=True)
class Draw:
    """A scan: the scene as text and as numbers, what varies, and how to have a scene of another value."""

    text: str
    scene: Scene
    name: str
    present: float
    at: Callable[[Scene, Floats], Scene]
    grid: Floats
    one_by_one: bool = False


def draw(generator: random.Random) -> Draw:
    """Return a scan at random."""
    pick, ms = generator.choice, Fraction(1, 1000)

    def decades(low: float, high: float) -> float:
        return float(f"{10 ** generator.uniform(low, high):.3g}")

    tick = ms * pick([Fraction(1), Fraction(1), Fraction(1, 2), Fraction(2)])
    period = tick * pick([1, 2, 4, 4, Fraction(5, 2)])
    late, contact = (pick([Fraction(0), tick, tick, ms * generator.randint(1, 250) / 100]) for _ in range(2))
    scene = Scene(
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
    name = pick(["contact.stiffness", "coordination.stiffness", "contact.setting", pick([*_FIELDS][2:])])
    text = text_of(scene)
    if name == "contact.setting":
        middle, high, present = decades(1, 3), decades(2.5, 4), decades(1, 3)
        width = float(f"{decades(-2, -0.5) * middle:.3g}")
        words = f"high: {high!r} N/m, setting: {present!r}, middle: {middle!r}, width: {width!r}"
        spring = (
            ("type: SampledSpringDamper", "type: Bump"),
            (f"stiffness: {scene.kc!r}", f"{words}, low: {scene.kc!r}"),
        )
        grid = np.concatenate([_spread(present), middle + width * np.linspace(-6, 6, GRID // 2)])

        def bumped(one: Scene, value: Floats) -> Scene:
            return replace(one, kc=scene.kc + high / (1 + ((value - middle) / width) ** 4))  # type: ignore[arg-type] # an array

        return Draw(replaced(text, *spring), scene, name, present, bumped, grid[grid > 0])
    present = float(getattr(scene, _FIELDS[name]))
    if name.endswith("stiffness"):
        return Draw(text, scene, name, present, partial(_with, _FIELDS[name]), _spread(present))
    # None of them a time at which events coincide.
    grid = (max(present, float(tick)) * 3) * (np.arange(DELAYS) + np.pi / 8) / DELAYS
    return Draw(text, scene, name, present, partial(_with, _FIELDS[name]), grid, one_by_one=True)


# What is scanned, and what `Scene` calls it.
_FIELDS = {
    "contact.stiffness": "kc",
    "coordination.stiffness": "kt",
    "contact.delay": "contact_comp",
    "coordination.delay": "comp",
    "lan.delay": "comm",
}


def _with(name: str, scene: Scene, value: Floats) -> Scene:
    return replace(scene, **{name: value})


def _spread(present: float) -> Floats:
    """Return a grid from next to nothing to far beyond the present value, evenly about it."""
    wide = np.geomspace(1e-9 * present, 900 * present, GRID // 2)
    return np.concatenate([wide, np.linspace(0, 6 * present, GRID // 2)[1:]])


def radii(scan: Draw, values: Floats) -> Floats:
    """Return the largest magnitude of any motion but the common translation, at values (k,)."""
    if scan.one_by_one:
        times = [Fraction(float(one)) for one in values]
        return np.array([_radii(scan.at(scan.scene, one), 1)[0] for one in times])  # type: ignore[arg-type] # an exact time
    return _radii(scan.at(scan.scene, values), len(values))


def _radii(scene: Scene, count: int) -> Floats:
    values = np.linalg.eigvals(frame_matrices(scene, count))
    sizes = np.abs(values)
    sizes[np.arange(count), np.argmin(np.abs(values - 1), axis=1)] = 0.0
    return np.asarray(sizes.max(axis=1))


def check(scan: Draw, found: apc.Critical) -> str:
    """Return what is wrong with a scan, "" if nothing is."""
    low, high = found.scanned
    if not low <= scan.present <= high:
        return f"the present value {scan.present!r} is not in what was scanned, {found.scanned}"
    edges = np.array([one.value for one in found.crossings])
    errors = np.array([one.error for one in found.crossings])
    values = [scan.grid[(scan.grid > low) & (scan.grid < high)]]
    for way in (-1, 1):
        beside = edges + way * (BESIDE * np.abs(edges) + 2 * errors)
        values.append(beside[(beside > low) & (beside < high)])
    points = np.concatenate(values)
    # Nearer to a crossing than its error nothing is claimed; nearer to another than the cell, neither.
    apart = np.abs(points[:, None] - edges[None]).min(axis=1, initial=np.inf)
    points = points[apart > 1.5 * errors.max(initial=0.0)]
    radius = radii(scan, points)
    if not len(found.crossings):
        claimed = np.full(len(points), found.verdict.startswith("stable"))
    else:
        sides = [found.crossings[0].stable_side == "below"]
        sides += [one.stable_side == "above" for one in found.crossings]
        claimed = np.array(sides)[np.searchsorted(edges, points)]
    wrong = (np.abs(radius - 1) > UNSURE) & (claimed != (radius < 1))
    if not wrong.any():
        return ""
    place = int(np.argmax(wrong))
    side = "stable" if claimed[place] else "unstable"
    return (
        f"{side} is claimed at {points[place]!r}, the radius is {radius[place]!r}; crossings {edges.tolist()}"
    )


@dataclass
class Tally:
    """What came out."""

    scans: int = 0
    crossings: int = 0
    estimated: int = 0
    open: int = 0
    seconds: float = 0.0
    kinds: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """Return a few lines."""
        words = ", ".join(f"{count} of {name}" for name, count in sorted(self.kinds.items()))
        return (
            f"{self.scans} scans: {words}\n{self.crossings} crossings, {self.estimated} without a proof; "
            f"{self.open} scans with an eigenvalue that follows the circle; {len(self.wrong)} wrong; "
            f"{self.seconds / max(self.scans, 1):.2f} s a scan"
        )


def run(points: int, *, seed: int = 0) -> Tally:
    """Scan so many random scenes, of a seed."""
    generator, tally = random.Random(seed), Tally()
    with single_threaded(), tempfile.TemporaryDirectory() as folder:
        parts = library(Path(folder), BUMP)
        for _ in range(points):
            scan = draw(generator)
            tally.kinds[scan.name] += 1
            tally.scans += 1
            try:
                taken, found = timed(partial(apc.critical, compiled(scan.text, parts), scan.name))
                fault = check(scan, found)
            except (apc.ApcError, AssertionError, ArithmeticError, IndexError, ValueError) as error:
                tally.wrong.append(f"{scan.name}: {error!r}\n{scan.text}")
                continue
            tally.seconds += taken
            tally.crossings += len(found.crossings)
            tally.estimated += sum(one.proof.startswith("estimated") for one in found.crossings)
            tally.open += not found.whole
            tally.wrong += [f"{scan.name}: {fault}\n{scan.text}"] if fault else []
    return tally


def main() -> None:
    """Print what came out, and every scan that is wrong."""
    parser = parser_of("random_scans", __doc__)
    parser.add_argument("--count", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    with judged(parser) as (judge, given):
        tally = run(40 if given.quick else given.count, seed=given.seed)
        print(tally)
        for one in tally.wrong:
            judge.right(one, holds=False)
        judge.within("crossings without a proof", tally.estimated, MOST_OPEN * tally.crossings)
        judge.within("scans left open", tally.open, MOST_OPEN * tally.scans)


if __name__ == "__main__":
    main()
