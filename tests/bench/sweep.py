"""A sweep that is killed again and again, against one left alone: the same file, and what the kills cost.

`python -m tests.bench.sweep` sweeps the paper's scene over contact and coordination stiffness, 100,000 points
by default, twice over: half a minute on two cores.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

import numpy as np

import apc
from apc.benchmark.timing import waited
from apc.sweeps.sweep import part_points
from tests.bench.judge import Judge, Timed, parser_of
from tests.sweeping import parts, start, wait_for_parts
from tests.topologies import SCENES


def finish(folder: Path, words: list[str]) -> str:
    """Run a sweep to its end; return what it printed."""
    out, err = start(folder, *words).communicate()
    assert not err, err
    return str(out)


def kill(folder: Path, words: list[str], target: Path, moment: int) -> None:
    """Start a sweep and kill it once so many parts are finished."""
    running = start(folder, *words)
    wait_for_parts(running, target, moment)
    running.kill()
    running.communicate()


def main() -> None:
    """Print the comparison, times by the clock on the wall."""
    parser = parser_of("sweep", __doc__)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--kills", type=int, default=3)
    given = parser.parse_args()
    judge, kills = Judge(given.strict), 1 if given.quick else given.kills
    side = max(2, round((5000 if given.quick else given.points) ** 0.5))
    names = ("contact.stiffness", "coordination.stiffness")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "scene.yaml").write_bytes((SCENES / "three-users-average.yaml").read_bytes())
        words = [word for one in names for word in ("--over", f"{one}=10 N/m:3000 N/m:{side}")]
        words = ["scene.yaml", *words, "--jobs", "2", "--out"]
        alone, target = folder / "alone.parquet", folder / "killed.parquet"
        left_alone, out = waited(lambda: finish(folder, [*words, alone.name]))
        print(out.rstrip())
        whole = -(-(side**2) // part_points(side**2, quick=True))
        seconds, before = 0.0, parts(target)
        for one in range(kills):
            moment = max(whole * (one + 1) // (kills + 1), len(before) + 1)
            seconds += waited(partial(kill, folder, [*words, target.name], target, moment))[0]
            now = parts(target)
            untouched = judge.right("finished parts are left as they are", before.items() <= now.items())
            print(
                f"  killed with {len(now):>6} parts of {whole} finished; those before untouched: {untouched}"
            )
            before = now
        rest, last = waited(lambda: finish(folder, [*words, target.name]))
        print(f"  {last.splitlines()[-1].strip()}")
        same = alone.read_bytes() == target.read_bytes()
        print(f"files the same: {judge.right('the same file, killed or not', same)}")
        axis = np.linspace(10.0, 3000.0, side)
        points = dict(zip(names, (one.ravel() for one in np.meshgrid(axis, axis)), strict=True))
        at_once, _ = waited(lambda: apc.analyze_many(SCENES / "three-users-average.yaml", points))
        programs = [
            Timed("apc sweep, two processes", left_alone),
            Timed(f"apc sweep, killed {kills} times", seconds + rest),
            Timed("apc.analyze_many, one process", at_once),
        ]
        judge.table(f"{side**2:,} points, by the clock on the wall", programs)
    judge.end()


if __name__ == "__main__":
    main()
