"""Error against time: what each method gives for its work, on three scenes.

Run it from the project's folder: `python -m tests.bench.work_precision [--plot FILE.png]`.

    stiff contact   a device bounces on a hard ball, by Hunt and Crossley's law; a contact lasts a millisecond
    soft contact    the same on foam; a contact lasts twenty
    arm             an arm holds a device that pushes a tool by a spring, forces at ticks: linear

The error is that of the positions, relative to the way they go, against the exact motion where there is one
and CVODES at 1e-14 elsewhere; that of the exact motion is what its roundings amount to. The time is that of
the run, without preparing it, as a part of real time.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.runtime.simulate.blocks import blocks
from apc.runtime.simulate.methods import Method
from apc.runtime.simulate.simulation import prepare
from apc.runtime.threads import single_threaded
from tests.topologies import compiled

DURATION = Fraction(1, 2)
REPEATS = 3
BALL = """\
topology: ball
clocks: {haptic: 1 ms}
peers: {user: {count: 1, set: {device.x: -3 mm, device.v: 0.3 m/s}}}
masses:
  device: {mass: 0.1 kg, damping: 0.1 N*s/m}
  ball:   {mass: 0.3 kg, damping: 1 N*s/m}
couplers:
  contact: {type: HuntCrossleyContact, a: device, b: ball, stiffness: STIFF, damping: DAMPING}
  seat: {type: SampledSpringDamper, a: ball, b: ground, stiffness: 500 N/m, damping: 1 N*s/m, clock: haptic}
hands: {hand: {type: ConstantForce, flange: device, force: 3 N}}
"""
ARM = """\
topology: arm
clocks: {haptic: 1 ms}
peers: {user: {count: 1, set: {device.x: 10 mm}}}
masses:
  device: {mass: 0.1 kg, damping: 0.5 N*s/m}
  tool:   {mass: 0.2 kg, damping: 0.5 N*s/m}
couplers:
  spring: {type: SampledSpringDamper, a: device, b: tool, stiffness: 600 N/m, damping: 1 N*s/m, clock: haptic}
hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 300 N/m, damping: 2 N*s/m}}
"""
SCENES = {
    "stiff contact": BALL.replace("STIFF", "3e6 N/m^(3/2)").replace("DAMPING", "1e6 N*s/m^(5/2)"),
    "soft contact": BALL.replace("STIFF", "2e4 N/m^(3/2)").replace("DAMPING", "1e4 N*s/m^(5/2)"),
    "arm": ARM,
}
MS = Fraction(1, 1000)
STEPS = (MS, MS / 2, MS / 5, MS / 10, MS / 20, MS / 50, MS / 100)
METHODS = {
    "semi-implicit Euler": [Method("semi-implicit", step=step) for step in STEPS],
    "Runge and Kutta, order 4": [Method("rk4", step=step) for step in STEPS],
    "CVODES": [Method("cvodes", tolerance=10.0**-n) for n in range(3, 13)],
    "exact": [Method("exact")],
}
LOOKS = {
    "semi-implicit Euler": ("s", ":"),
    "Runge and Kutta, order 4": ("^", "--"),
    "CVODES": ("o", "-"),
    "exact": ("*", ""),
}


@dataclass(frozen=True, slots=True)
class Point:
    """A run: how it was played, its error relative to the range, its time as a part of real time."""

    method: Method
    error: float
    part: float


def played(system: CompiledSystem, method: Method) -> tuple[NDArray[np.float64], float]:
    """Return the positions and the seconds that the run took, the best of some."""
    ready = prepare(system, DURATION, signals=["*.x"], method=method)
    taken = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        rows = [block.values for block in blocks(ready)]
        taken.append(time.perf_counter() - began)
    return np.concatenate(rows), min(taken)


def measured(text: str) -> dict[str, list[Point]]:
    """Return the points of all methods on a scene."""
    system = compiled(text)
    linear = "HuntCrossley" not in text
    truth, _ = played(system, Method("exact") if linear else Method("cvodes", tolerance=1e-14))
    span = np.ptp(truth, axis=0)
    found: dict[str, list[Point]] = {}
    for name, methods in METHODS.items():
        if name == "exact" and not linear:
            continue
        for method in methods:
            rows, seconds = played(system, method)
            if name == "exact":  # it is the truth but for rounding: what that amounts to
                rows, _ = played(system, Method("exact", shaken=True))
            error = float((np.abs(rows - truth) / span).max())
            found.setdefault(name, []).append(Point(method, error, seconds / float(DURATION)))
    return found


def draw(results: dict[str, dict[str, list[Point]]], path: Path) -> None:
    """Draw a panel a scene."""
    from matplotlib.figure import Figure

    from apc.runtime.simulate.figures import write_figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    axes = figure.subplots(1, len(results), sharey=True)
    for ax, (scene, found) in zip(axes, results.items(), strict=True):
        for name, points in found.items():
            marker, line = LOOKS[name]
            errors = [one.error for one in points]
            parts = [one.part for one in points]
            ax.loglog(parts, errors, marker=marker, linestyle=line, label=name, markersize=5)
        ax.set_title(scene)
        ax.set_xlabel("time of the run / simulated time")
        ax.grid(visible=True, linewidth=0.4, alpha=0.5)
    axes[0].set_ylabel("largest error of a position / its range")
    handles, labels = axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    write_figure(figure, path)


def main() -> None:
    """Print the table, and draw it if a file is named."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.work_precision", description=__doc__)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw it: .png, .svg or .pdf")
    path = parser.parse_args().plot
    results = {}
    with single_threaded():
        for scene, text in SCENES.items():
            results[scene] = measured(text)
            print(
                f"\n{scene}, {float(DURATION):g} s\n  {'method':<24}{'error / range':>14}{'of real time':>14}"
            )
            for points in results[scene].values():
                for one in points:
                    print(f"  {one.method!s:<24}{one.error:>14.1e}{one.part:>14.5f}")
    if path is not None:
        draw(results, path)


if __name__ == "__main__":
    main()
