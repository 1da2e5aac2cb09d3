"""`python -m tests.fuzz --inputs 100000 --seed 1`: exit code 1 when an input does what none may.

Each different failure is told once, with a smaller input of the same failure in a folder.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tests.fuzz.inputs import SORTS
from tests.fuzz.packets import run_packets
from tests.fuzz.running import FORGERIES, once, run_all, run_forged, shrunk
from tests.topologies import AVERAGE, compiled


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=2000, help="how many hostile inputs (default 2000)")
    for what in FORGERIES:
        parser.add_argument(f"--{what}", type=int, default=0, help=f"how many forged {what}")
    parser.add_argument("--packets", type=int, default=0, help="how many forged datagrams")
    parser.add_argument("--scenes", type=int, default=0, help="how many valid scenes against brute force")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", type=int, default=0, help="the first input of the seed to run")
    parser.add_argument("--sort", choices=[name for name, _, _ in SORTS], help="inputs of this sort only")
    parser.add_argument("--out", type=Path, default=Path("fuzz-failures"), help="where failures are written")
    options = parser.parse_args()
    began = time.monotonic()
    failures, often, outcomes = run_all(
        options.inputs,
        options.seed,
        start=options.start,
        sort=options.sort,
        progress=lambda text: print(text, file=sys.stderr, flush=True),
    )
    for outcome, number in sorted(outcomes.items()):
        print(f"{number:8d}  {outcome}")
    print(f"{options.inputs - options.start} inputs in {time.monotonic() - began:.0f} s")
    for number, failure in enumerate(sorted(failures, key=lambda one: -often[one.key]), start=1):
        small = shrunk(failure)
        _, told = once(small)
        folder = options.out / f"{number:02d}"
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in small.files:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
        came = f"seed {options.seed}, input {failure.index}, {often[failure.key]} times"
        text = f"{failure.key}\n{came}\n\n{told or failure.told}\n"
        (folder / "told.txt").write_text(text, encoding="utf-8")
        print(f"\n{folder}: {text}")
    wrong = bool(failures)
    for what in FORGERIES:
        if count := getattr(options, what):
            wrong |= _forged(what, count, options.seed, options.out)
    if options.packets:
        wrong |= _packets(options.packets, options.seed)
    if options.scenes:
        from tests.lifting.test_frame import check_scenes

        check_scenes(options.scenes)
        print(f"{options.scenes} scenes agree with brute force")
    return int(wrong)


def _packets(count: int, seed: int) -> bool:
    """Give forged datagrams to a peer, tell of those that were taken, and return whether any was."""
    failures, outcomes = run_packets(compiled(AVERAGE), count, seed)
    for sort, number in sorted(outcomes.items()):
        print(f"{number:8d}  datagram: {sort}")
    print(f"{count} forged datagrams, {len(failures)} taken or not survived", *failures, sep="\n")
    return bool(failures)


def _forged(what: str, count: int, seed: int, out: Path) -> bool:
    """Run forged files, tell what came of them, and return whether anything was wrong."""
    failures, outcomes = run_forged(what, count, seed)
    for outcome, number in sorted(outcomes.items()):
        print(f"{number:8d}  {what}: {outcome}")
    print(f"{count} forged {what}")
    for number, (key, (index, told)) in enumerate(failures.items(), start=1):
        folder = out / f"{what}-{number:02d}"
        for name, content in FORGERIES[what][1](f"{seed}/{index}")[1]:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        text = f"{key}\nseed {seed}, number {index}\n\n{told}\n"
        (folder / "told.txt").write_text(text, encoding="utf-8")
        print(f"\n{folder}: {text}")
    return bool(failures)


if __name__ == "__main__":
    sys.exit(main())
