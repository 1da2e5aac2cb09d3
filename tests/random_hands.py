"""Random scenes and random passive hands, against a program of its own: `python -m tests.random_hands 2000`.

Of each scene: the verdict, and the damping needed, against the map of `joined` on a grid of angles; where it
is passive, no hand may shake it, be it a mass, damper and spring at every device or a network that joins
devices; where it isn't, a heavy hand tuned to the frequency told often does. Every third scene is of the
paper's form and goes through hands alone.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

import apc
from apc.compiler.compiled import CompiledSystem
from apc.compiler.components.library import Library
from apc.frame.devices import held
from apc.hands.passivity import PassiveHands, passive_hands
from tests.joined import LIBRARY, MS, Group, Hands, Table, moved, radii
from tests.topologies import AVERAGE, MESH, compiled, library, replaced

# Angles of a grid, to which those of the frequencies told are added; what damping may be off by, relatively.
ANGLES, MISSED = 200, 1e-7

# The least angle: at 0 the map has a pole, which rounding can't take out nearby.
POLE = 3e-5

# What a double eigenvalue 1 may be off by.
ROUNDED = 1e-7

# Draws after which a long run says how far it is.
EVERY = 10

# Of the hands of a scene, one in so many joins devices.
JOINED = 10


@dataclass
class Tally:
    """What came out."""

    scenes: int = 0
    passive: int = 0
    undecided: int = 0
    clamped_unstable: int = 0
    uneven: int = 0  # at rest, devices pull each other unevenly
    not_passive: int = 0
    tried: int = 0  # of those, with hands tuned to the frequency told
    shaken: int = 0  # of these
    hands: int = 0
    joined: int = 0
    farthest: float = 0.0  # the largest difference of the damping needed, of the largest damping
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """Return a line."""
        return (
            f"{self.scenes} scenes: {self.passive} passive, of {self.hands:,} hands at devices and "
            f"{self.joined:,} that join them {len(self.wrong)} exceptions; {self.not_passive} not passive, "
            f"{self.shaken} of {self.tried} shaken by a tuned hand; {self.uneven} uneven at rest, "
            f"{self.clamped_unstable} unstable clamped, {self.undecided} undecided; "
            f"damping needed off by {self.farthest:.1e} at most"
        )


def random_scene(random: np.random.Generator) -> str:
    """Return a few users with random numbers, delays and groups."""
    groups = int(random.integers(1, 3))
    pick = random.choice
    text = replaced(
        AVERAGE if random.random() < 0.5 else MESH,
        ("haptic: 1 ms", f"haptic: {pick(['1 ms', '2 ms', '4 ms'])}"),
        ("stiffness: 1000 N/m", f"stiffness: {10 ** random.uniform(1.5, 3.3):.5g} N/m"),
        ("stiffness: 500 N/m", f"stiffness: {10 ** random.uniform(1, 3):.5g} N/m"),
        (
            "mass: 0.1 kg, damping: 5",
            f"mass: {10 ** random.uniform(-2, 0):.5g} kg, damping: {10 ** random.uniform(0, 2):.5g}",
        ),
        (
            "mass: 0.6 kg, damping: 5",
            f"mass: {10 ** random.uniform(-1, 1):.5g} kg, damping: {10 ** random.uniform(0, 1.5):.5g}",
        ),
        ("delay: 8 ms", f"delay: {pick(['0 ms', '3 ms', '8 ms', '21 ms'])}"),
        ("delay: 1 ms", f"delay: {pick(['0 ms', '1 ms', '1.5 ms', '4 ms'])}"),
        ("delay: 1 ms", f"delay: {pick(['0 ms', '1 ms', '3 ms'])}"),
    )
    one = f"user: {{count: {random.integers(2, 6)}}}"
    if groups == 2:
        heavy = f"{{device.mass: {10 ** random.uniform(-2, 0):.4g} kg}}"
        other = f"other: {{count: {random.integers(1, 4)}, set: {heavy}}}"
        one = f"{one}\n  {other}"
    return replaced(text, ("user: {count: 3}", one))


def random_table(random: np.random.Generator) -> Table:
    """Return a few users: groups with clocks, delays and dampings of their own, backward differences."""

    def between(low: float, high: float) -> float:
        return float(f"{10 ** random.uniform(low, high):.4g}")

    def one_of(*values: int) -> int:
        return int(random.choice(values))

    backward = random.random() < 0.4
    even, pull = random.random() < 0.9, between(1, 2.8)
    groups = [
        Group(
            name="ab"[place],
            count=one_of(1, 2, 3),
            device=between(-2, 0),
            damping=between(-0.5, 1.3),
            contact=between(1.7, 3.1),
            backward=between(-1, 0.5) if backward else 0.0,
            late=one_of(0, 2, 2, 3, 4) * MS / 2,
            clock=("haptic", "slow")[one_of(0, 0, 1)],
            pull=pull if even else between(1, 2.5),
            pull_late=one_of(0, 2, 3, 5) * MS / 2,
        )
        for place in range(one_of(1, 2))
    ]
    users = sum(one.count for one in groups)
    if users == 1:
        groups.append(Group("b", 2, 0.1, 5.0, groups[0].contact, 0.0, MS, "haptic", pull, MS))
    phase = one_of(0, 0, 0, 3) * MS / 10
    return Table(
        groups=tuple(groups),
        clocks={
            "haptic": (MS, phase),
            "slow": (2 * MS, Fraction(0)),
            "network": (one_of(4, 8) * MS, one_of(0, 0, 3) * MS / 10),
        },
        late=one_of(0, 3, 8, 11) * MS,
        cube=between(-0.5, 0.5),
        drag=between(-0.5, 1.5),
        kind=("AveragePosition", "FullMesh")[one_of(0, 1)],
        graph="ring" if users > 3 and random.random() < 0.4 else "complete",
    )


def random_hands(random: np.random.Generator, users: int) -> Hands:
    """Return masses, springs and dampers that hold devices, join them, and masses of their own behind."""
    many = users + int(random.integers(0, 3))
    mass = 10 ** random.uniform(-3, 2, many)
    mass[:users] *= random.random(users) < 0.6
    found = []
    for low, high in ((-3, 3), (0, 5)):
        matrix = np.zeros((many, many))
        for _ in range(int(random.integers(0, 2 * many))):
            ends = np.zeros(many)
            ends[random.integers(many)] = 1
            if random.random() < 0.6:
                ends[random.integers(many)] -= 1
            matrix += 10 ** random.uniform(low, high) * np.outer(ends, ends)
        found.append(matrix)
    return Hands(np.diag(mass), *found)


def tuned(table: Table, hertz: float) -> Iterator[Hands]:
    """Yield masses on springs which would sway at a frequency by themselves: at all devices, or one group's.

    Others are free or can hardly be moved.
    """
    users = len(table.sites)
    none = np.zeros((users, users))
    whole = [np.ones(users)]
    for group in table.groups:
        own = np.array([float(one is group) for one in table.sites])
        whole += [own, np.where(own > 0, own, 1e6)] if len(table.groups) > 1 else []
    for mass in (300.0, 10.0, 1.0, 0.1):
        for shape in whole:
            held = np.diag(shape * mass)
            yield Hands(held, none, (2 * np.pi * hertz) ** 2 * held)


def check_table(table: Table, own: Library, random: np.random.Generator, hands: int, tally: Tally) -> None:
    """Compare a scene's verdict with the truth, and hold its devices."""
    system = compiled(table.text, own)
    found = passive_hands(system)
    tally.scenes += 1
    truth = moved(table)
    turn = 2 * np.pi * float(table.frame)
    told = [turn * one.frequency_hz for one in found.modes if one.frequency_hz is not None]
    told = [angle for angle in told if abs(np.sin(angle / 2)) > POLE]
    angles = [POLE, 1e-3, *np.linspace(np.pi / ANGLES, np.pi, ANGLES)]
    least = min(map(truth.least, [*told, *angles]))
    largest = max(one.damping for one in table.groups)
    scale = max(largest, abs(least))
    more = found.worst.more if found.worst is not None else None
    if abs(found.clamped_radius - truth.clamped) > ROUNDED:
        tally.wrong.append(f"radius clamped {found.clamped_radius}, truth {truth.clamped}\n{table.text}")
    if not found.joined:  # what is told is of hands each by itself, which the truth here is not
        _hold(system, found, random, hands, tally, table.text)
        return
    if found.stable and (truth.clamped >= 1 or least < -1e-9 * scale):
        tally.wrong.append(f"called passive, {least} at clamped {truth.clamped}\n{table.text}")
    if found.stable is False and truth.clamped < 1 and least > 1e-9 * scale:
        tally.wrong.append(f"called not passive, {least}\n{table.text}")
    if more is not None:
        tally.farthest = max(tally.farthest, abs(least + more) / scale)
        if abs(least + more) > MISSED * scale:
            tally.wrong.append(f"{more} N*s/m more needed, in truth {-least}\n{table.text}")
    _hold(system, found, random, hands, tally, table.text)
    if found.stable:
        for _ in range(hands // JOINED):
            one = random_hands(random, len(table.sites))
            tally.joined += 1
            if radii(table, one)[-1] > 1 + ROUNDED:
                tally.wrong.append(f"shaken by {one}\n{table.text}")
    elif more is not None and found.stable is False:
        drawing = [one.frequency_hz for one in found.modes if one.passive is False]
        tally.tried += 1
        tally.shaken += any(
            radii(table, one)[-1] > 1 + 1e-9
            for hertz in drawing
            if hertz is not None
            for one in (*tuned(table, hertz), *tuned(table, 0.7 * hertz))
        )


def _hold(
    system: CompiledSystem,
    found: PassiveHands,
    random: np.random.Generator,
    hands: int,
    tally: Tally,
    name: str,
) -> None:
    """Count a verdict, and put hands on what is passive."""
    if found.stable is None:
        tally.undecided += found.joined
        tally.uneven += not found.joined
    elif not found.stable:
        lost = any(one.more is None for one in found.modes)
        tally.clamped_unstable += found.clamped_stable is False
        tally.uneven += lost and found.clamped_stable is not False
        tally.not_passive += not lost
    else:
        tally.passive += 1
        drawn = 10 ** random.uniform(-6, [3, 4, 7], size=(hands, 3))
        drawn[random.random((hands, 3)) < 0.2] = 0.0
        names = ("hand.mass", "hand.damping", "hand.stiffness")
        many = apc.analyze_many(held(system, option=""), dict(zip(names, drawn.T, strict=True)))
        tally.hands += hands
        tally.wrong += [f"shaken by {drawn[k].tolist()}\n{name}" for k in range(hands) if many.stable[k] == 0]


def exceptions(seed: int, scenes: int, hands: int, *, say: bool = False) -> Tally:
    """Judge so many random scenes, with so many hands on each that is passive."""
    tally = Tally()
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        own = library(Path(folder), LIBRARY)
        for number in range(scenes):
            random = np.random.default_rng([seed, number])
            before = len(tally.wrong)
            if number % 3:
                check_table(random_table(random), own, random, hands, tally)
            else:
                text = random_scene(random)
                system = compiled(text)
                tally.scenes += 1
                _hold(system, passive_hands(system), random, hands, tally, text)
            if say:
                for text in tally.wrong[before:]:
                    print(f"wrong, draw {number} of seed {seed}: {text}", flush=True)
                if (number + 1) % EVERY == 0:
                    print(f"{time.perf_counter() - start:.0f} s, {tally}", flush=True)
    return tally


if __name__ == "__main__":
    count, first = (*(int(one) for one in sys.argv[1:]), *(2000, 0)[len(sys.argv) - 1 :])
    told = exceptions(first, count, 100, say=True)
    print(told)
    sys.exit(bool(told.wrong))
