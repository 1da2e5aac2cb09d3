# ruff: noqa: E501 -- tables are printed by long lines
"""How long compiling takes, against peers, different peers, kinds and equations: `python -m tests.bench.language`.

Each line is the median of a few runs in a warm process, so that loading libraries counts nowhere. A ratio compares with
the line before; next to it stands the one that growth in proportion would have.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from apc.benchmark.timing import median_time, timed
from apc.compiler.components.library import Library
from apc.compiler.errors import Place
from apc.compiler.language.tables import read_table
from apc.compiler.pipeline import STAGES, each_stage
from apc.threads import single_threaded
from tests.bench.growing import equations, flat, kinds, table
from tests.bench.judge import Judge, parser_of
from tests.topologies import SCENES


def stage_times(path: Path, runs: int) -> list[float]:
    """Return the seconds of each stage, medians of some runs."""
    rows = []
    for _ in range(runs):
        stages = each_stage(path)
        rows.append([timed(partial(next, stages))[0] for _ in STAGES])
    return [statistics.median(times) for times in zip(*rows, strict=True)]


def print_table(
    title: str,
    count: str,
    numbers: list[int],
    write: Callable[[int, Path], str],
    judge: Judge,
    target: float | None = None,
) -> float:
    """Measure and print one table; its last line is judged by the target (seconds), and its seconds returned."""
    print(
        f"\n{title}\n{count:>9}  "
        + "  ".join(f"{stage:>9}" for stage in STAGES)
        + "      total   ratio (in proportion)"
    )
    before, total = 0.0, 0.0
    for place, number in enumerate(numbers):
        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / "scene.yaml"
            path.write_text(write(number, path.parent), encoding="utf-8")
            times = stage_times(path, 1 if before > 2 else 3)
            total = sum(times)
            ratio = f"{total / before:8.2f} ({number / numbers[place - 1]:.3g})" if place else ""
            extra = ""
            if write is table:
                many = path.parent / "many.csv"
                reading, _ = median_time(partial(read_table, many, Place("scene.yaml")), 3)
                extra = f"   reading the table {100 * reading / total:.0f} %"
            print(
                f"{number:>9}  "
                + "  ".join(f"{1000 * one:6.1f} ms" for one in times)
                + f"  {total:7.3f} s{ratio}{extra}"
            )
            before = total
    if target is not None:
        print(f"target {target:g} s: {judge.in_time(title, total, target)}")
    return total


def in_rumoca(number: int) -> float | None:
    """Return the seconds in which Rumoca makes the same chain's sorted equations; None where it is not installed."""
    if find_spec("rumoca") is None:
        return None
    masses = max(1, number // 3)
    names = range(1, masses + 1)
    lines = [
        "model Chain",
        "  parameter Real k = 10; parameter Real c = 1; parameter Real m = 0.01; parameter Real x0 = 0;",
    ]
    lines += [f"  Real x{i}(start = 0); Real v{i}(start = 0); Real f{i};" for i in names]
    lines.append("equation")
    for i in names:
        behind = f" - f{i + 1}" if i < masses else ""
        lines.append(f"  der(x{i}) = v{i}; f{i} = k*(x{i - 1} - x{i}); m*der(v{i}) = f{i} - c*v{i}{behind};")
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "Chain.mo"
        path.write_text("\n".join([*lines, "end Chain;", ""]), encoding="utf-8")
        session = import_module("rumoca").Session
        seconds, _ = median_time(lambda: session().load(str(path), model="Chain").structure, 3)
    return seconds


def main() -> None:
    """Print the tables."""
    parser = parser_of("language", __doc__)
    parser.add_argument("--quick", action="store_true", help="leave out the largest of each")
    given = parser.parse_args()
    judge = Judge(given.strict)
    for name in Library().component_names:
        Library().component(name)
    with single_threaded():
        for _ in each_stage(SCENES / "three-users-average.yaml"):
            pass
        last = -1 if given.quick else None
        print_table(
            "equal peers (flat)", "peers", [3, 10, 100, 1000, 10**4, 10**5, 10**6][:last], flat, judge
        )
        rows = [3, 100, 10**3, 10**4, 10**5][:last]
        print_table("different peers, from a table (linear)", "peers", rows, table, judge, 10)
        print_table("kinds of peers", "kinds", [1, 2, 4, 8, 16, 32][:last], kinds, judge)
        lengths = [10, 30, 100, 300, 1000][:last]
        ours = print_table("equations in one component", "equations", lengths, equations, judge, 10)
        theirs = in_rumoca(lengths[-1])
        if theirs is not None:
            work = f"{lengths[-1]:,} equations to sorted ones"
            judge.beside(f"{work} and functions", (ours, "–"), "Rumoca, without functions", (theirs, "–"))
            print(f"\n{work} in Rumoca: {theirs:.3f} s")
    judge.end()


if __name__ == "__main__":
    main()
