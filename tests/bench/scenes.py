"""Whether the default is on the Pareto front of every scene of models/: `python -m tests.bench.scenes`."""

from __future__ import annotations

import math

from apc.benchmark.bench import bench
from apc.compiler.pipeline import compile_topology
from tests.bench.judge import Judge, parser_of
from tests.topologies import SCENES


def main() -> None:
    """Print a line a scene and task; a default off the front is a missed target, as times decide it too."""
    parser = parser_of("scenes", __doc__)
    parser.add_argument("--rounds", type=int, default=15)
    names = sorted(path.stem for path in SCENES.glob("*.yaml"))
    parser.add_argument("names", nargs="*", metavar="SCENE", help="only these")
    given = parser.parse_args()
    print(f"{'scene':<20} {'task':<9} {'chosen':<12} {'median':>9} {'error':>9} {'bound':>9}  front")
    judge = Judge(given.strict)
    for name in given.names or names:
        for one in bench(compile_topology(SCENES / f"{name}.yaml"), rounds=given.rounds).comparisons:
            chosen = one.chosen
            assert chosen is not None
            error, bound = (f"{v:.1e}" if v is not None else "–" for v in (chosen.error, chosen.bound))
            others = ", ".join(m.name for m in one.measured if m.front and not m.chosen)
            if chosen.error is None:
                where = "no reference"
            else:
                where = ("yes" if chosen.front else "NO") + (f"; also {others}" if others else "")
            print(
                f"{name:<20} {one.task:<9} {chosen.name:<12} {1e3 * chosen.seconds:6.2f} ms "
                f"{error:>9} {bound:>9}  {where}",
                flush=True,
            )
            if chosen.error is not None and not chosen.front:
                judge.missed.append(f"{name}, {one.task}: {chosen.name} is not on the front")
            says = chosen.bound is None or math.isfinite(chosen.bound)
            judge.right(f"{name}, {one.task}: the bound says nothing", says)
            for line in one.faults:
                print(f"  {line}")
                judge.right(f"{name}, {one.task}: {line}", holds=False)
    judge.end()


if __name__ == "__main__":
    main()
