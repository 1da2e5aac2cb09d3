"""A sweep that is killed again and again, against one left alone: the same file, and what the kills cost.

`python -m tests.bench.sweep` sweeps the paper's scene over contact and coordination stiffness, 100,000 points
by default, twice over: half a minute on two cores. `--points 2000` is quick.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import tempfile
from functools import partial
from pathlib import Path

from apc.benchmark.timing import timed, waited
from apc.compiler.pipeline import compile_topology
from apc.compiler.store import save
from apc.sweeps.grid import build_grid, parse_axis
from apc.sweeps.quantities import find_quantity
from apc.sweeps.sweep import part_points
from apc.threads import single_threaded
from tests.sweeping import parts, start, wait_for_parts
from tests.topologies import SCENES


def axes(points: int) -> dict[str, str]:
    """Return two axes whose grid has about so many points."""
    side = max(2, round(points**0.5))
    return {
        "contact.stiffness": f"10 N/m:3000 N/m:{side}",
        "coordination.stiffness": f"10 N/m:3000 N/m:{max(2, round(points / side))}",
    }


def plain(model: Path, over: dict[str, str], count: int) -> float:
    """Return the processor seconds a point takes in one process without parts, over the first points."""
    from apc.inputs import load_fresh

    system = load_fresh(model)
    grid = build_grid([parse_axis(system, name, text) for name, text in over.items()])
    quantity = find_quantity(system, "analyze")
    with single_threaded():
        quantity.cells(grid, range(count))
        return timed(lambda: quantity.cells(grid, range(count)))[0] / count


def finish(folder: Path, words: list[str]) -> tuple[str, float]:
    """Run a sweep to its end; return what it printed and the seconds it took."""
    seconds, (out, err) = waited(lambda: start(folder, *words).communicate())
    assert not err, err
    return out, seconds


def _kill(folder: Path, words: list[str], target: Path, moment: int) -> None:
    """Start a sweep and kill it once so many parts are finished."""
    running = start(folder, *words)
    wait_for_parts(running, target, moment)
    running.kill()
    running.communicate()


def killed(folder: Path, words: list[str], target: Path, kills: int, points: int) -> float:
    """Kill a sweep so many times at moments spread evenly over its work; return the seconds it ran in all."""
    whole = -(-points // part_points(points, quick=True))
    moments = [whole * (kill + 1) // (kills + 1) for kill in range(kills)]
    seconds = 0.0
    before: dict[str, tuple[int, int]] = {}
    for moment in moments:
        seconds += waited(partial(_kill, folder, words, target, max(moment, len(before) + 1)))[0]
        now = parts(target)
        kept = before.items() <= now.items()
        print(f"  killed with {len(now):>6} parts of {whole} finished; those of before untouched: {kept}")
        assert kept
        before = now
    return seconds


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.sweep", description=__doc__)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--suffix", choices=["parquet", "csv"], default="parquet")
    given = parser.parse_args()
    over = axes(given.points)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = folder / "scene.apc"
        save(compile_topology(SCENES / "three-users-average.yaml"), model)
        words = ["scene.apc", *(word for axis in over.items() for word in ("--over", "=".join(axis)))]
        words += ["--jobs", str(given.jobs)]
        alone, target = folder / f"alone.{given.suffix}", folder / f"killed.{given.suffix}"
        out, left_alone = finish(folder, [*words, "--out", alone.name])
        used = resource.getrusage(resource.RUSAGE_CHILDREN)  # of processes that have ended
        cpu = used.ru_utime + used.ru_stime
        print(out.rstrip())
        points = int(out.split(": ")[1].split(" ")[0].replace(",", ""))
        print(f"\nleft alone: {left_alone:.1f} s, {points / left_alone:.0f} points a second")
        took = killed(folder, [*words, "--out", target.name], target, given.kills, points)
        last, rest = finish(folder, [*words, "--out", target.name])
        print(f"  {last.splitlines()[-1].strip()}")
        same = alone.read_bytes() == target.read_bytes()
        digest = hashlib.sha256(target.read_bytes()).hexdigest()
        print(f"killed {given.kills} times: {took + rest:.1f} s")
        print(f"files the same: {same} (SHA-256 {digest[:16]}…)")
        print(f"time killed / left alone: {(took + rest) / left_alone:.2f}")
        each = plain(model, over, min(5000, points))
        print(f"processor time / that of as many points in one process: {cpu / (each * points):.2f}")
        assert same


if __name__ == "__main__":
    main()
