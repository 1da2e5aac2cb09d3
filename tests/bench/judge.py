"""What decides how a benchmark ends: a wrong number is code 1, a missed target of time only with `--strict`.

A number is judged by its own bound, or by what it must be by construction, and is wrong on every machine. How
long something takes is the machine's: a target is printed as kept, or missed, or near where it is missed by
no more than two runs of one program differ.

What another program takes for the same work is taken down too: the rows printed at the end are those of the
first table of the page (`tests.bench.__main__`).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field

# Two medians of one program on one machine differ by up to a quarter where others work beside it.
NOISE = 1.25
# The first line of the rows of other programs; they alone begin as it does.
ROW = "| "
HEAD = f"{ROW}work | apc | its error | other program | it takes | its error | apc / other |"


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
        """Take down whether a time, or a ratio of times, is at most its target.

        Parameters
        ----------
        what
            Is measured.
        value, most
            What it is and its target, in the same unit.
        noise
            The factor by which it may be above its target and count as no miss: 1 of what isn't a time.
        """
        if value <= most:
            return "kept"
        if value <= most * noise:
            return "near"
        self.missed.append(f"{what}: {value:.3g}, target {most:.3g}")
        return "missed"

    def beside(self, work: str, ours: tuple[float, str], other: str, theirs: tuple[float, str]) -> None:
        """Take down what another program takes for the same work.

        Parameters
        ----------
        work
            That both do.
        ours, theirs
            The seconds, and the error in words with its unit where it has one.
        other
            The other program.
        """
        (seconds, error), (their_seconds, their_error) = ours, theirs
        cells = (
            work,
            time_of(seconds),
            error,
            other,
            time_of(their_seconds),
            their_error,
            f"{seconds / their_seconds:.3g}",
        )
        self.rows.append(ROW + " | ".join(cells) + " |")

    @property
    def code(self) -> int:
        """The code to end with."""
        return int(bool(self.wrong) or (self.strict and bool(self.missed)))

    def end(self) -> None:
        """Say what was wrong and missed, and end the program.

        Raises
        ------
        SystemExit
            Always: with code 1 if a number was wrong, or if a target was missed and these count.
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


def parser_of(name: str, about: str | None) -> argparse.ArgumentParser:
    """Return the parser of a benchmark that is judged.

    Parameters
    ----------
    name
        Of the module in `tests.bench`.
    about
        Its docstring.
    """
    parser = argparse.ArgumentParser(prog=f"python -m tests.bench.{name}", description=about)
    parser.add_argument("--strict", action="store_true", help="a missed target of time is a failure too")
    return parser
