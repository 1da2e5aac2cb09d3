# ruff: noqa: E501 -- tables are printed by long lines
"""Populations of any size, time beside error: `python -m tests.bench.populations [--quick]`.

Whole processes are started anew, those that are compared in turn, and of each the median of a few runs counts:
their ratio does not depend on the machine. Their memory is the largest resident set. The truth is the dense
matrix where it can be had, and for a long delay a Newton iteration at 50 digits.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from apc.analysis.analysis import Analysis, analyze, prepare
from apc.benchmark.timing import median_time, waited
from apc.threads import single_threaded
from tests.bench.judge import Judge, parser_of
from tests.populations import different
from tests.sites import MS, grouped, linked, paper

ROOT = Path(__file__).parent.parent.parent

# What a process does: build a system, analyse it, and print what it took.
PROCESS = """
import resource, sys
sys.path.insert(0, {root!r})
from tests.bench.populations import scene
from apc.analysis.analysis import analyze
found = analyze(scene({name!r}))
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(found.method, found.spectral_radius, found.spectral_radius_error, memory, found.verdict, sep="|")
"""

# A million equal peers are the same two systems as three: a process of them takes as long but for noise.
AS_LONG = 1.0

GROUPS = (("left", {"device.mass": 0.2}), ("mid", {}), ("right", {"contact.stiffness": 700.0}))
GAINS = {"kt": 400.0, "bt": 1.0, "kc": 1000.0, "bc": 1.0}


def scene(name: str) -> Any:
    """Return a scene by its name."""
    kind, _, number = name.partition(" ")
    count = int(number)
    match kind:
        case "equal":
            return paper(peers=count, **GAINS)
        case "groups":
            return grouped(paper(**GAINS), *((group, count, own) for group, own in GROUPS))
        case "ring":
            return linked(paper(peers=count, **GAINS), "ring")
        case "different":
            return different(count)
        case "different-ring":
            return different(count, graph="ring")
    return paper(peers=3, comm=8 * MS * count, kt=20.0, bt=0.2, kc=1000.0, bc=1.0)


def processes(names: tuple[str, ...], runs: int) -> dict[str, tuple[float, str]]:
    """Return the median seconds of the processes of each scene, run in turn, and what the last printed."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    times: dict[str, list[float]] = {name: [] for name in names}
    printed = {}
    for _ in range(runs):
        for name in names:
            words = [sys.executable, "-c", PROCESS.format(root=str(ROOT), name=name)]
            start = partial(
                subprocess.run, words, capture_output=True, text=True, check=True, env=environment
            )
            took, ran = waited(start)
            times[name].append(took)
            printed[name] = ran.stdout.strip()
    return {name: (statistics.median(times[name]), printed[name]) for name in names}


def print_process(name: str, took: float, printed: str, note: str = "") -> None:
    """Print one line of a process."""
    method, radius, error, memory, verdict = printed.split("|")
    print(
        f"{name:<24}{took:8.2f} s{float(memory):9.0f} MiB  {float(radius):.15f} ± {float(error):.0e}  {method:<12}{verdict}{note}"
    )


def compared(names: tuple[str, str], runs: int, judge: Judge) -> None:
    """Print two processes and the ratio of their times."""
    found = processes(names, runs)
    ratio = found[names[1]][0] / found[names[0]][0]
    kept = judge.in_time(f"{names[1]} against {names[0]}", ratio, AS_LONG)
    print_process(names[0], *found[names[0]])
    print_process(names[1], *found[names[1]], note=f"   ratio {ratio:.2f}, target {AS_LONG:g} {kept}")


def warm(system: Any, method: str = "auto", runs: int = 5) -> tuple[float, Analysis]:
    """Return the median seconds of an analysis in this process, and the analysis."""
    return median_time(partial(analyze, system, method=method, prepared=prepare(system)), runs)


def print_against_dense(sizes: tuple[int, ...], judge: Judge) -> None:
    """Print analyses of different peers beside the dense matrix."""
    print("\ndifferent peers against the dense matrix, in a warm process")
    for graph, method in (("complete", "determinant"), ("ring", "krylov")):
        for peers in sizes:
            system = different(peers, graph=graph)
            took, found = warm(system, method, runs=3)
            whole_took, whole = warm(system, "dense", runs=1)
            apart = abs(found.spectral_radius - whole.spectral_radius)
            most = found.spectral_radius_error + whole.spectral_radius_error
            said = judge.within(f"{peers} {graph} against dense", apart, most)
            print(
                f"{peers:>5} {graph:<9} {found.method:<12}{took:8.3f} s  ± {found.spectral_radius_error:.0e}  off by {apart:.0e} {said}   dense {whole_took:8.3f} s"
            )


def print_long_delays(frames: tuple[int, ...], judge: Judge) -> None:
    """Print analyses of long delays; the error is against Newton's method at 50 digits."""
    print("\nlong delays, in a warm process")
    for count in frames:
        took, found = warm(scene(f"delay {count}"))
        apart = abs(_in_50_digits(count, found) - found.spectral_radius)
        said = judge.within(f"delay of {count} frames", apart, found.spectral_radius_error)
        print(
            f"{count:>5} frames {found.method:<12}{took * 1e3:8.1f} ms  ± {found.spectral_radius_error:.0e}  off by {apart:.0e} {said}"
        )


def _in_50_digits(frames: int, found: Analysis) -> float:
    """Return the largest zero's magnitude, from peers stepped one by one at 50 digits."""
    import mpmath

    from tests.bruteforce import Scene, frame_matrix

    with mpmath.workdps(50):
        values = {"kt": 20.0, "bt": 0.2, "kc": 1000.0, "bc": 1.0}
        rows = frame_matrix(Scene(peers=2, **values), number=mpmath.mpf, exp=mpmath.exp)
        half = len(rows) // 2
        packet = half - 4
        own, heard, sent = range(packet), range(half + packet, half + packet + 2), range(packet, packet + 2)
        p, q, s = (
            mpmath.matrix([[rows[i][j] for j in columns] for i in lines])
            for lines, columns in ((own, own), (own, heard), (sent, own))
        )
        # Two peers hear one another with weight 1, three the mean of two: a difference weighs −1/2.
        weight = mpmath.mpf(1) if found.modes[0].shape == "common" else -mpmath.mpf(1) / 2

        def function(point: Any) -> Any:
            inside = mpmath.inverse(point * mpmath.eye(p.rows) - p) * q
            return mpmath.det(mpmath.eye(2) - weight * point**-frames * (s * inside))

        after = mpmath.mpc(found.modes[0].eigenvalue)
        before = after * (1 + mpmath.mpf("1e-12"))
        value_before, value = function(before), function(after)
        while abs(after - before) > mpmath.mpf("1e-30"):
            step = value * (after - before) / (value - value_before)
            before, value_before, after = after, value, after - step
            value = function(after)
        return float(abs(after))


def main() -> None:
    """Print every table."""
    parser = parser_of("populations", __doc__)
    parser.add_argument("--quick", action="store_true", help="smaller sizes, fewer runs")
    given = parser.parse_args()
    judge, quick = Judge(given.strict), given.quick
    runs = 3 if quick else 5
    np.seterr(all="ignore")
    print("whole processes, medians of some, run in turn")
    compared(("equal 3", "equal 1000000"), runs, judge)
    compared(("groups 3", "groups 100000"), runs, judge)
    for name in ("ring 1000", "ring 100000", "different 1000", "different 100000", "different-ring 2000"):
        if not (quick and name in ("different 100000", "different-ring 2000")):
            took, printed = processes((name,), 1 if name.startswith("different") else runs)[name]
            print_process(name, took, printed)
            judge.right(f"{name}: the verdict is left open", "undecided" not in printed)
    with single_threaded():
        print_against_dense((10, 40) if quick else (10, 40, 100), judge)
        print_long_delays((1, 10, 1000) if quick else (1, 10, 100, 1000, 5000), judge)
    judge.end()


if __name__ == "__main__":
    main()
