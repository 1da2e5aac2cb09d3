"""This version beside another, question by question over all topologies: `python -m tests.bench.paired
OTHER`.

OTHER is the Python of an environment in which another version of apc is installed. Both answer the same
question on the same topology in turn, in one process each, with one thread. A number is wrong if the two are
farther apart than both their errors, a verdict if it is another one; a time is that of a processor. What one
version answers and the other does not is listed with its message.

Without OTHER, or after the comparison, every critical value of a stiffness, damping or delay is bracketed: an
analysis on each side of it, by a few times its error, has to give the verdict that the value states.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import apc
from apc.analysis_report import answer

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("models/topologies", "tests/small_topologies", "tests/hard")
LONGEST_S = 60
Numbers = list[tuple[float, float]]


def _named(model: Any, ending: str) -> list[str]:
    return [row.name for row in apc.parameters(model).rows if row.name.endswith(ending)]


def _critical(model: Any, ending: str, place: int) -> tuple[str, Numbers]:
    found = apc.critical(model, _named(model, ending)[place])
    sides = " ".join(str(crossing.stable_side) for crossing in found.crossings)
    return sides, [(crossing.value, crossing.error) for crossing in found.crossings]


def _analyze(model: Any) -> tuple[str, Numbers]:
    found = apc.analyze(model)
    return found.verdict, [(found.spectral_radius, found.spectral_radius_error)]


def _region(model: Any) -> tuple[str, Numbers]:
    x, y = _named(model, "stiffness")[:2]
    found = apc.region(model, x=f"{x}=10 N/m:3000 N/m", y=f"{y}=10 N/m:2000 N/m")
    return "", [(found.stable_area, found.stable_area_error)]


def _simulate(model: Any) -> tuple[str, Numbers]:
    found = apc.simulate(model, duration="0.5 s")
    ends = {one.name: float(value) for one, value in zip(found.signals, found.values[-1], strict=True)}
    return "", [(ends[name], 1e-5 * max(1.0, abs(ends[name]))) for name in sorted(ends)]


# An analysis has bounds of its own: it is asked so many errors from a critical value, and so much of the
# value besides. An error above the widest, relatively, is a fault of the search if analyses nearer decide.
ASIDE, MORE, WIDEST = 3.0, 1e-9, 1e-6


def _bracketed(model: Any, name: str, criterion: str) -> tuple[str, Numbers]:
    """Return what is wrong with the critical values of a parameter, and the values with their errors."""
    found = apc.critical(model, name, criterion=criterion)
    decide = apc.absolute_stability if criterion == "passive" else apc.analyze

    def stable(value: float) -> bool | None:
        return decide(model, params={name: f"{value!r} {found.unit}".removesuffix(" 1")}).stable

    def side(crossing: Any, aside: float) -> tuple[bool | None, bool | None]:
        below, above = (stable(crossing.value + way * aside) for way in (-1, 1))
        return (below, above) if crossing.stable_side == "below" else (above, below)

    wrong = []
    for crossing in found.crossings:
        if crossing.kind == "period":  # its ends are analysed, and no period near them has a short frame
            continue
        size, least = abs(crossing.value), WIDEST * abs(crossing.value)
        label = f"{name} {criterion} {crossing.value:.10g} ± {crossing.error:.1g}"
        inner, outer = side(crossing, ASIDE * crossing.error + MORE * size)
        if inner is False or outer is True:
            wrong.append(f"{label}: analyses give {inner}, {outer}")
        elif crossing.error > least and None not in side(crossing, least):
            wrong.append(f"{label}: analyses nearer decide")
        elif None in (inner, outer):
            wrong.append(f"{label}: open at {ASIDE:g} times its error")
    return "; ".join(wrong), [(crossing.value, crossing.error) for crossing in found.crossings]


QUESTIONS: dict[str, Callable[..., tuple[str, Numbers]]] = {
    "analyze": _analyze,
    "first stiffness": lambda model: _critical(model, "stiffness", 0),
    "last delay": lambda model: _critical(model, "delay", -1),
    "region": _region,
    "passive hands": lambda model: (apc.absolute_stability(model).verdict, []),
    "simulate": _simulate,
    "default output": lambda model: (answer(model).analysis.verdict, []),
    "bracketed": _bracketed,
}
BRACKETED = "bracketed"
# By what names end in: how stable is meant. The first so many of each topology are asked.
BRACKETS = {
    "stiffness": ("nominal", "passive"),
    "damping": ("nominal", "passive"),
    "delay": ("nominal",),
    "period": ("nominal", "passive"),
}
EACH = 2


def serve() -> None:
    """Answer the questions on standard input, a line each, as long as there are any."""

    class TooLong(BaseException):
        """The time is up; no handler of errors may catch it."""

    def stop(*_: object) -> None:
        raise TooLong

    signal.signal(signal.SIGALRM, stop)
    models: dict[str, Any] = {}
    for line in sys.stdin:
        file, question, runs, *more = json.loads(line)
        reported: dict[str, Any] = {"refused": "", "words": "", "numbers": [], "seconds": []}
        signal.alarm(LONGEST_S)
        try:
            models[file] = models.get(file) or apc.compile(file)
            for _ in range(runs):
                begun = time.process_time()
                reported["words"], reported["numbers"] = QUESTIONS[question](models[file], *more)
                reported["seconds"].append(time.process_time() - begun)
        except TooLong:
            reported["refused"] = f"took more than {LONGEST_S} s"
        except Exception as error:
            reported["refused"] = f"{type(error).__name__}: {str(error)[:120].splitlines()[0]}"
        signal.alarm(0)
        print(json.dumps(reported), flush=True)


def started(python: str) -> subprocess.Popen[str]:
    """Start a version that answers questions, with one thread and nothing of this checkout on its path."""
    threads = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    command, pipe = [python, "-P", str(Path(__file__)), "--serve"], subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd="/", env=threads, bufsize=1)


def answered(version: subprocess.Popen[str], *question: object) -> dict[str, Any]:
    """Return what a version says to a topology's file, a question and a number of runs."""
    assert version.stdin is not None and version.stdout is not None
    version.stdin.write(json.dumps(question) + "\n")
    return dict(json.loads(version.stdout.readline()))


@dataclass(slots=True)
class Pairs:
    """What two versions took and how they differ, over the topologies."""

    seconds: list[tuple[float, float, str]] = field(default_factory=list)
    bounds: list[float] = field(default_factory=list)
    different: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def add(self, topology: str, ours: dict[str, Any], theirs: dict[str, Any]) -> None:
        """Take down the two answers of a topology."""
        if ours["refused"] or theirs["refused"]:
            if ours["refused"] != theirs["refused"]:
                who = "this version" if ours["refused"] else "the other"
                self.refused.append(f"{topology}: {who}: {ours['refused'] or theirs['refused']}")
            return
        self.seconds.append((min(ours["seconds"]), min(theirs["seconds"]), topology))
        pairs = list(zip(ours["numbers"], theirs["numbers"], strict=False))
        self.bounds += [a[1] / b[1] for a, b in pairs if b[1] > 0 and a[1] < float("inf")]
        apart = any(abs(a[0] - b[0]) > a[1] + b[1] for a, b in pairs)
        unequal = len(ours["numbers"]) != len(theirs["numbers"])
        if apart or unequal or ours["words"] != theirs["words"]:
            printed = [f"{answer['words']} {answer['numbers'][:3]}" for answer in (ours, theirs)]
            self.different.append(f"{topology}: {printed[0]}, the other {printed[1]}")

    def report(self, question: str) -> None:
        """Print what the topologies took, and where the answers differ."""
        print(f"\n{question}: {len(self.seconds)} topologies answered by both")
        if self.seconds:
            ours, theirs = (sum(row[place] for row in self.seconds) for place in (0, 1))
            ratios = sorted((row[0] / max(row[1], 1e-6), row[2]) for row in self.seconds)
            middle = statistics.median(ratio for ratio, _ in ratios)
            print(
                f"  {theirs:.3g} s -> {ours:.3g} s; "
                f"ratio: median {middle:.2f}, largest {ratios[-1][0]:.2f} ({ratios[-1][1]})"
            )
        if self.bounds:
            print(f"  bounds: median {statistics.median(self.bounds):.2f}, largest {max(self.bounds):.2f}")
        for title, rows in (("different", self.different), ("answered by only one", self.refused)):
            for row in rows:
                print(f"  {title}: {row}")


def bracketed(version: subprocess.Popen[str], files: Sequence[Path]) -> bool:
    """Print and return whether analyses hold every critical value of all topologies on both sides."""
    held, widest, good = 0, 0.0, True
    refused = {"refused": 0, "took too long": 0}
    print(f"\n{BRACKETED}:", flush=True)
    for file in files:
        try:
            model = apc.compile(file)
        except apc.ApcError:
            continue
        requested = [
            (name, criterion)
            for ending, criteria in BRACKETS.items()
            for name in _named(model, ending)[:EACH]
            for criterion in criteria
        ]
        for name, criterion in requested:
            reported = answered(version, str(file), BRACKETED, 1, name, criterion)
            wrong, numbers = reported["words"], reported["numbers"]
            if reported["refused"].startswith("took"):
                refused["took too long"] += 1
            elif reported["refused"].startswith("ApcError"):
                refused["refused"] += 1
            elif reported["refused"]:
                wrong = f"{name} {criterion}: {reported['refused']}"
            held += len(numbers)
            widest = max([widest, *(error / abs(value) for value, error in numbers if value)])
            good = good and not wrong
            if wrong:
                print(f"  not held: {file.stem}: {wrong}", flush=True)
    print(f"  {held} critical values, the widest relative error {widest:.1g}; {refused}")
    return good


def main() -> None:
    """Ask both versions every question on every topology, and print the comparison."""
    from tests.bench.judge import Judge, parser_of

    parser = parser_of("paired", __doc__)
    parser.add_argument("other", nargs="?", help="the Python of the other version's environment")
    parser.add_argument("--only", action="append", choices=QUESTIONS, help="may be repeated")
    given = parser.parse_args()
    judge = Judge(given.strict)
    ours = started(sys.executable)
    files = [file for folder in FOLDERS for file in sorted((ROOT / folder).glob("*.yaml"))]
    files = files[:5] if given.quick else files
    chosen = given.only or list(QUESTIONS)
    theirs = started(given.other) if given.other else ours
    for question in [one for one in chosen if one != BRACKETED] if given.other else []:
        pairs, runs = Pairs(), 3 if question == "analyze" else 1
        for file in files:
            requested = (str(file), question, runs)
            pairs.add(file.stem, answered(ours, *requested), answered(theirs, *requested))
        pairs.report(question)
        judge.right(f"{question}: the same answers", not pairs.different)
    if BRACKETED in chosen:
        judge.right(f"{BRACKETED}: analyses on both sides of every critical value", bracketed(ours, files))
    judge.end()


if __name__ == "__main__":
    if "--serve" in sys.argv:
        serve()
    else:
        main()
