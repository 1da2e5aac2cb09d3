"""`python -m tests.fuzz --inputs 100000 --seed 1`: exit code 1 when an input does what none may.

Each different failure is told once, its input in a folder.
"""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from pathlib import Path

from tests.fuzz.inputs import SORTS
from tests.fuzz.models import FORGERIES
from tests.fuzz.packets import run_packets
from tests.fuzz.running import kind_of, run_all
from tests.topologies import AVERAGE, compiled


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    number = partial(parser.add_argument, type=int)
    number("--inputs", default=2000, help="how many hostile inputs (default 2000)")
    for what in FORGERIES:
        number(f"--{what}", default=0, help=f"how many forged {what}")
    number("--packets", default=0, help="how many forged datagrams")
    number("--topologies", default=0, help="how many valid topologies against brute force")
    number("--seed", default=1)
    number("--start", default=0, help="the first input of the seed to run")
    parser.add_argument("--sort", choices=[name for name, _, _ in SORTS], help="inputs of this sort only")
    parser.add_argument("--out", type=Path, default=Path("fuzz-failures"), help="where failures are written")
    options = parser.parse_args()
    wrong = False
    for what in ("inputs", *FORGERIES):
        if getattr(options, what):
            wrong |= _run(what, options)
    if options.packets:
        failures, outcomes = run_packets(compiled(AVERAGE), options.packets, options.seed)
        for sort, often in sorted(outcomes.items()):
            print(f"{often:8d}  datagram: {sort}")
        print(
            f"{options.packets} forged datagrams, {len(failures)} taken or not survived", *failures, sep="\n"
        )
        wrong |= bool(failures)
    if options.topologies:
        from tests.lifting.test_frame import check_topologies

        check_topologies(options.topologies)
        print(f"{options.topologies} topologies agree with brute force")
    return int(wrong)


def _run(what: str, options: argparse.Namespace) -> bool:
    """Run hostile inputs, or forged files, tell what came of them, and return whether anything was wrong."""
    kind, began, count = kind_of(what, options.sort), time.monotonic(), getattr(options, what)
    is_input = what == "inputs"
    start = options.start if is_input else 0
    progress = partial(print, file=sys.stderr, flush=True)
    failures, often, outcomes = run_all(kind, count, options.seed, start=start, progress=progress)
    for outcome, times in sorted(outcomes.items()):
        print(f"{times:8d}  {outcome if is_input else f'{what}: {outcome}'}")
    title = "inputs" if is_input else f"forged {what}"
    print(f"{count - start} {title} in {time.monotonic() - began:.0f} s")
    for place, failure in enumerate(sorted(failures, key=lambda one: -often[one.key]), start=1):
        folder = options.out / f"{what}-{place:02d}"
        came = f"seed {options.seed}, number {failure.index}, {often[failure.key]} times"
        text = f"{failure.key}\n{came}\n\n{failure.reported}\n"
        for name, data in (*failure.given.files, ("told.txt", text.encode())):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        print(f"\n{folder}: {text}")
    return bool(failures)


if __name__ == "__main__":
    sys.exit(main())
