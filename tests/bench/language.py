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
from pathlib import Path

from apc.benchmark.timing import median_time, timed
from apc.compiler.components.library import Library
from apc.compiler.errors import Place
from apc.compiler.language.tables import read_table
from apc.compiler.pipeline import STAGES, each_stage
from apc.threads import single_threaded
from tests.bench.judge import Judge, parser_of
from tests.topologies import AVERAGE, SCENES, replaced


def flat(peers: int, folder: Path) -> str:
    """Return a scene of equal peers."""
    return replaced(AVERAGE, ("count: 3", f"count: {peers}"))


def table(peers: int, folder: Path) -> str:
    """Return a scene of different peers, a row each, and write their table."""
    rows = "\n".join(f"{0.1 + 1e-7 * i:.7f},{5 + i % 7},{800 + i % 1000}" for i in range(peers))
    headings = "device.mass [kg],device.damping [N*s/m],contact.stiffness [N/m]"
    (folder / "many.csv").write_text(f"{headings}\n{rows}\n", encoding="utf-8")
    return replaced(AVERAGE, ("{count: 3}", "{table: many.csv}"))


def kinds(number: int, folder: Path) -> str:
    """Return a scene of groups that each have one hand more or fewer, so that each is a kind."""
    groups = "".join(f"  g{i}: {{count: 3}}\n" for i in range(number))
    hands = "".join(
        f"  h{i}: {{type: SpringDamperArm, flange: device, stiffness: 10 N/m, damping: 1 N*s/m, at: [g{i}]}}\n"
        for i in range(number)
    )
    return replaced(AVERAGE, ("  user: {count: 3}\n", groups), ("studies:", f"hands:\n{hands}studies:"))


def equations(number: int, folder: Path) -> str:
    """Return a scene with one component of so many equations: a chain of masses and springs, written out."""
    masses = max(1, number // 3)
    (folder / "parts").mkdir(exist_ok=True)
    names = range(1, masses + 1)
    variables = "".join(
        f"  x{i}: {{unit: m, start: 0}}\n  v{i}: {{unit: m/s, start: 0}}\n  f{i}: {{unit: N}}\n"
        for i in names
    )
    lines = []
    for i in names:
        before = "flange.x" if i == 1 else f"x{i - 1}"
        lines += [
            f"  - der(x{i}) = v{i}",
            f"  - f{i} = stiffness*({before} - x{i})",
            f"  - mass*der(v{i}) = f{i} - damping*v{i}" + (f" - f{i + 1}" if i < masses else ""),
        ]
    text = (
        "component: Chain\nabout: Masses in a row, held together by springs.\nconnectors: {flange: Flange}\nparameters:\n"
        "  stiffness: {unit: N/m, min: 0}\n  damping: {unit: N*s/m, min: 0}\n  mass: {unit: kg, above: 0}\nvariables:\n"
        + variables + "equations:\n" + "\n".join(lines) + "\n  - flange.f = f1\n"
    )  # fmt: skip
    (folder / "parts" / "chain.yaml").write_text(text, encoding="utf-8")
    chain = (
        "hands:\n  chain: {type: Chain, flange: device, stiffness: 10 N/m, damping: 1 N*s/m, mass: 10 g}\n"
    )
    return replaced(AVERAGE, ("clocks:", "library: parts\nclocks:"), ("studies:", f"{chain}studies:"))


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
) -> None:
    """Measure and print one table; its last line is judged by the target (seconds)."""
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
        print_table("equations in one component", "equations", lengths, equations, judge, 10)
    judge.end()


if __name__ == "__main__":
    main()
