"""Error against time: what each method gives for its work, on three scenes.

Run it from the project's folder: `python -m tests.bench.work_precision [--plot FILE.png]`.

    stiff contact   a device bounces on a hard ball, by Hunt and Crossley's law; a contact lasts a millisecond
    soft contact    the same on foam; a contact lasts twenty
    arm             an arm holds a device that pushes a tool by a spring, forces at ticks: linear

The error is that of the positions, relative to the way they go, against programs that share no method with
those compared: fifty digits event by event (`tests.fifty_digits`) for the arm, equations by hand and a method
of order 8 (`tests.bench.contact_reference`) for the contacts. The time is that of the run, without preparing
it, as a part of real time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apc.benchmark.timing import median_time
from apc.compiler.compiled import CompiledSystem
from apc.simulation.blocks import blocks
from apc.simulation.settings import CVODES, EXACT, TOLERANCE, Method, Settings
from apc.simulation.simulation import Simulation, prepare
from apc.threads import single_threaded
from tests.bench.contact_reference import Bounce, reference
from tests.bench.judge import Judge, parser_of
from tests.fifty_digits.truth import exact_course
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
CONTACTS = {"stiff contact": (3e6, 1e6), "soft contact": (2e4, 1e4)}  # N/m^(3/2), N·s/m^(5/2)
# Errors of a step add up over a run: at the default's tolerance to hundreds of times that, which is what
# `methods.TOLERANCE` says and what is judged. Of other tolerances nothing is said: in the stiff contact 1e-11
# and 1e-12 come to some 2,000 times theirs. Exact transitions round at each of 500 ticks.
ADDED_UP, ROUNDED = 1e3, 1e-12
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


def played(system: CompiledSystem, method: Method) -> tuple[NDArray[np.float64], float, tuple[str, ...]]:
    """Return the positions, the median seconds of some runs, and the names of the positions."""
    ready = prepare(system, Settings(DURATION, method), signals=["*.x"])
    seconds, rows = median_time(partial(_rows, ready), REPEATS)
    return rows, seconds, tuple(signal.name for signal in ready.signals)


def _rows(ready: Simulation) -> NDArray[np.float64]:
    return np.concatenate([block.values for block in blocks(ready)])


def contact_text(stiffness: float, damping: float) -> str:
    """Return the scene of a device and a ball."""
    text = BALL.replace("STIFF", f"{stiffness!r} N/m^(3/2)")
    return text.replace("DAMPING", f"{damping!r} N*s/m^(5/2)")


def contact(name: str, methods: Sequence[Method]) -> tuple[dict[Method, Point], float]:
    """Return a point a method on a scene with a contact, and how far its reference is certain."""
    truth, doubt = reference(Bounce(*CONTACTS[name]), int(DURATION / MS))
    system = compiled(contact_text(*CONTACTS[name]))
    return _points(system, methods, ("user[1].device.x", "user[1].ball.x"), truth), doubt


def arm(methods: Sequence[Method]) -> dict[Method, Point]:
    """Return a point a method on the linear scene."""
    system = compiled(ARM)
    course = exact_course(system, DURATION)
    assert not isinstance(course, str), course
    names, rows = course
    places = [place for place, name in enumerate(names) if name.endswith(".x")]
    return _points(system, methods, tuple(names[place] for place in places), rows[:, places])


def _points(
    system: CompiledSystem, methods: Sequence[Method], names: tuple[str, ...], truth: NDArray[np.float64]
) -> dict[Method, Point]:
    """Return what each method takes and is off by; `names` are those of the columns of `truth`."""
    span = np.ptp(truth, axis=0)
    found = {}
    for method in methods:
        rows, seconds, of_rows = played(system, method)
        apart = np.abs(rows[:, [of_rows.index(name) for name in names]] - truth)
        found[method] = Point(method, float((apart / span).max()), seconds / float(DURATION))
    return found


def check(scene: str, points: Iterable[Point], doubt: float, judge: Judge) -> None:
    """Judge what a scene's points must keep; `doubt` is how far its truth is certain."""
    for one in points:
        method = one.method
        if method.name == EXACT:
            judge.within(f"{scene}, {method}", one.error, ROUNDED)
        elif method == Method(CVODES, tolerance=TOLERANCE):
            judge.within(f"{scene}, {method}", one.error, ADDED_UP * TOLERANCE + doubt)


def draw(results: dict[str, dict[Method, Point]], path: Path) -> None:
    """Draw a panel a scene."""
    from matplotlib.figure import Figure

    from apc.present.pictures import write_figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    axes = figure.subplots(1, len(results), sharey=True)
    for ax, (scene, found) in zip(axes, results.items(), strict=True):
        for name, methods in METHODS.items():
            points = [found[method] for method in methods if method in found]
            if not points:
                continue
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
    parser = parser_of("work_precision", __doc__)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw it: .png, .svg or .pdf")
    given = parser.parse_args()
    judge = Judge(given.strict)
    every = [method for methods in METHODS.values() for method in methods]
    stepped = [method for method in every if method.name != EXACT]
    results: dict[str, dict[Method, Point]] = {}
    with single_threaded():
        for scene in (*CONTACTS, "arm"):
            doubt = 0.0
            if scene in CONTACTS:
                results[scene], doubt = contact(scene, stepped)
            else:
                results[scene] = arm(every)
            print(f"\n{scene}, {float(DURATION):g} s, the truth certain to {doubt:.0e}")
            print(f"  {'method':<24}{'error / range':>14}{'of real time':>14}")
            for one in results[scene].values():
                print(f"  {one.method!s:<24}{one.error:>14.1e}{one.part:>14.5f}")
            check(scene, results[scene].values(), doubt, judge)
    if given.plot is not None:
        draw(results, given.plot)
    judge.end()


if __name__ == "__main__":
    main()
