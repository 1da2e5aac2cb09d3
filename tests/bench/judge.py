"""What decides how a benchmark ends: a wrong number is code 1, a missed target of time only with `--strict`.

A number is judged by its own bound, or by what it must be by construction, and is wrong on every machine. How
long something takes is the machine's: a target is printed as kept, or missed, or near where it is missed by
no more than two runs of one program differ.

`Judge.table` prints programs that do the same work, ours first. What others take is taken down too: the rows
printed at the end are those of the first table of the page (`tests.bench.__main__`).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

R = TypeVar("R")

# Two medians of one program on one machine differ by up to a quarter where others work beside it.
NOISE = 1.25
# The first line of the rows of other programs; they alone begin as it does.
ROW = "| "
HEAD = f"{ROW}work | apc | its error | other program | it takes | its error | apc / other |"


@dataclass(frozen=True, slots=True)
class Timed:
    """What a program takes, in seconds, how far it is off, and the most it may be; a remark in words."""

    program: str
    seconds: float
    error: float | None = None
    bound: float | None = None
    remark: str = ""

    def report_of(self, unit: str) -> str:
        """Return the error in words."""
        if self.error is None:
            return self.remark or "–"
        return f"{self.error:.1e}" + ("" if self.bound is None else f" ≤ {self.bound:.1e}") + unit


@dataclass(slots=True)
class Judge:
    """What was `wrong`, and which targets were `missed`; `strict` says whether these count too.

    `rows` are those of other programs.
    """

    strict: bool = False
    wrong: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    rows: list[str] = field(default_factory=list)

    def right(self, what: str, holds: bool) -> str:
        """Take down whether something is as it must be; return the word for the table."""
        if not holds:
            self.wrong.append(what)
        return "right" if holds else "WRONG"

    def within(self, what: str, error: float, bound: float) -> str:
        """Take down whether an error is at most its bound, which no error without a value is."""
        return self.right(f"{what}: {error:.2g}, at most {bound:.2g}", error <= bound)

    def in_time(self, what: str, value: float, most: float, noise: float = NOISE) -> str:
        """Take down whether a time, or a ratio of times, is at most its target, or `noise` times that."""
        if value <= most:
            return "kept"
        if value <= most * noise:
            return "near"
        self.missed.append(f"{what}: {value:.3g}, target {most:.3g}")
        return "missed"

    def table(
        self,
        work: str,
        programs: Sequence[Timed],
        *,
        unit: str = "",
        most_s: float | None = None,
        most: Mapping[str, float] | None = None,
    ) -> None:
        """Print programs that do the same work, the first of them ours, and judge errors and times.

        What has a bound is judged by it, ours also by the seconds `most_s` and by how many times as long as
        another it may take (`most`, by name). Names that begin with apc are no other programs.
        """
        ours = programs[0]
        print(f"\n{work}")
        for one in programs:
            words = [f"  {one.program:<36}{time_of(one.seconds):>9}", f"{one.seconds / ours.seconds:9.3g}"]
            words.append(f" {one.report_of(unit)}")
            if one.error is not None and one.bound is not None:
                words.append(self.within(f"{work}, {one.program}", one.error, one.bound))
            if one is ours and most_s is not None:
                words.append(f"target {time_of(most_s)} {self.in_time(work, one.seconds, most_s)}")
            if target := (most or {}).get(one.program):
                ratio = ours.seconds / one.seconds
                words.append(
                    f"target {target:g} {self.in_time(f'{work}, beside {one.program}', ratio, target)}"
                )
            print(" ".join(words))
            if not one.program.startswith("apc"):
                cells = [work, time_of(ours.seconds), ours.report_of(unit), one.program, time_of(one.seconds)]
                cells += [one.report_of(unit), f"{ours.seconds / one.seconds:.3g}"]
                self.rows.append(f"{ROW}{' | '.join(cells)} |")

    @property
    def code(self) -> int:
        """The code to end with."""
        return int(bool(self.wrong) or (self.strict and bool(self.missed)))

    def end(self) -> None:
        """Say what was wrong and missed, and end the program: with code 1 if a number was wrong.

        A missed target counts too where it is `strict`.
        """
        print()
        if self.rows:
            print("\n".join([HEAD, *self.rows]) + "\n")
        for what in self.missed:
            print(f"missed {what}")
        for what in self.wrong:
            print(f"WRONG {what}")
        if not self.wrong:
            print("every number is right")
        raise SystemExit(self.code)


def time_of(seconds: float) -> str:
    """Return a time with its unit, to three digits."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def parser_of(name: str, description: str | None) -> argparse.ArgumentParser:
    """Return the parser of the benchmark in a module of a name, with its docstring."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.bench.{name}", description=description)
    parser.add_argument("--strict", action="store_true", help="a missed target of time is a failure too")
    parser.add_argument("--quick", action="store_true", help="smaller sizes, fewer runs")
    return parser


@contextmanager
def decided(parser: argparse.ArgumentParser) -> Iterator[tuple[Judge, argparse.Namespace]]:
    """Give a judge and what the command line says, one core's worth of threads, and end the program."""
    import numpy as np  # not by who measures processes: one begins as a copy

    from apc.support.threads import single_threaded

    given = parser.parse_args()
    judge = Judge(given.strict)
    with single_threaded(), np.errstate(all="ignore"):
        yield judge, given
    judge.end()


def elapsed(call: Callable[[], R]) -> tuple[float, R]:
    """Return the wall-clock seconds of a call, the processes it starts included, and its result."""
    began = time.perf_counter()
    result = call()
    return time.perf_counter() - began, result
