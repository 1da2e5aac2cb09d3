"""Cost against size: numbers of peers, frames of delay, points: `python -m tests.bench.growth --out FILE`.

Processor time of one analysis, or of all points, from the compiled model to the verdict; the least of some
runs, after one that is not counted. Equal peers form a few small systems, so their number must not matter:
an analysis of a million that takes more than twice that of three is a missed target.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import apc
from apc.output.pictures import COLOURS, write_figure
from tests.bench.judge import Judge, parser_of

TOPOLOGIES = Path(__file__).resolve().parents[2] / "models" / "topologies"
EQUAL, DIFFERENT = (3, 1_000, 1_000_000), (10, 100, 1_000)
FRAMES, POINTS = (1, 10, 100, 300, 1_000), (100, 1_000, 10_000, 100_000)
RUNS = 5
MOST_RATIO = 2.0

Curve = Sequence[tuple[int, float]]


def least_time(work: Callable[[], object], runs: int) -> float:
    """Return the least processor time of some runs in seconds, after a first one."""
    times = []
    for _ in range(runs + 1):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times[1:])


def curves(runs: int, sizes: Mapping[str, Sequence[int]]) -> dict[str, Curve]:
    """Return the times of each question by size."""
    average: Any = apc.compile(TOPOLOGIES / "three-users-average.yaml")
    generator = np.random.default_rng(0)

    def equal(count: int) -> Callable[[], object]:
        return lambda: apc.analyze(average, params={"user.count": count})

    def different(count: int) -> Callable[[], object]:
        masses = ", ".join(f"{0.05 + 0.1 * value:.6f} kg" for value in generator.random(count))
        text = (TOPOLOGIES / "three-users-average.yaml").read_text(encoding="utf-8")
        assert "user: {count: 3}" in text
        file = Path(f"different-{count}.yaml")
        file.write_text(text.replace("user: {count: 3}", f"user: {{set: {{device.mass: [{masses}]}}}}"))
        model = apc.compile(file)
        file.unlink()
        return lambda: apc.analyze(model)

    def delayed(frames: int) -> Callable[[], object]:
        return lambda: apc.analyze(
            average, params={"lan.delay": frames * 8e-3, "coordination.stiffness": 1.0}
        )

    def points(count: int) -> Callable[[], object]:
        values = np.linspace(10, 3000, count)
        return lambda: apc.analyze_many(average, {"contact.stiffness": values})

    questions = {
        "equal peers": equal,
        "different peers": different,
        "frames of delay": delayed,
        "points": points,
    }
    return {
        name: [(size, least_time(questions[name](size), runs)) for size in listed]
        for name, listed in sizes.items()
    }


def draw(found: Mapping[str, Curve]) -> Any:
    """Return a figure with one logarithmic panel for each question."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.6), layout="constrained")
    for axes, (name, curve), colour in zip(
        figure.subplots(1, len(found)), found.items(), COLOURS, strict=False
    ):
        axes.loglog(*zip(*curve, strict=True), marker="o", color=colour)
        axes.set_xlabel(name)
        axes.grid(visible=True, which="major", alpha=0.3)
        axes.set_ylim(1e-3, 1e2)
    figure.axes[0].set_ylabel("processor time [s]")
    return figure


def main() -> None:
    """Print the table, and draw it."""
    parser = parser_of("growth", __doc__)
    parser.add_argument("--out", type=Path, help="draw it into this file: .svg, .png or .pdf")
    given = parser.parse_args()
    sizes = {"equal peers": EQUAL, "different peers": DIFFERENT, "frames of delay": FRAMES, "points": POINTS}
    if given.quick:
        sizes = {name: listed[:-1] for name, listed in sizes.items()}
    found, judge = curves(1 if given.quick else RUNS, sizes), Judge(given.strict)
    for name, curve in found.items():
        print(f"{name:<16}" + "".join(f" {size:>11,}" for size, _ in curve))
        print(f"{'':<16}" + "".join(f" {seconds:>9.4f} s" for _, seconds in curve))
    first, last = (found["equal peers"][end][1] for end in (0, -1))
    print(f"\nequal peers: {last / first:.2f} times {judge.in_time('equal peers', last / first, MOST_RATIO)}")
    if given.out:
        write_figure(draw(found), given.out)
    judge.end()


if __name__ == "__main__":
    main()
