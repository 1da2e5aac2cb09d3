"""What decides how a benchmark ends: a wrong number is code 1, a missed target of time only with `--strict`.

A number is judged by its own bound, or by what it must be by construction, and is wrong on every machine. How
long something takes is the machine's: a target is printed as kept or missed.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field


@dataclass(slots=True)
class Judge:
    """What was `wrong`, and which targets were `missed`; `strict` says whether these count too."""

    strict: bool = False
    wrong: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)

    def right(self, what: str, holds: bool) -> str:
        """Take down whether something is as it must be; return the word for the table."""
        if not holds:
            self.wrong.append(what)
        return "right" if holds else "WRONG"

    def within(self, what: str, error: float, bound: float) -> str:
        """Take down whether an error is at most its bound, which no error without a value is."""
        return self.right(f"{what}: {error:.2g}, at most {bound:.2g}", error <= bound)

    def in_time(self, what: str, value: float, most: float) -> str:
        """Take down whether a time, or a ratio of times, is at most its target."""
        if not value <= most:
            self.missed.append(f"{what}: {value:.3g}, target {most:.3g}")
        return "kept" if value <= most else "missed"

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
        for what in self.missed:
            print(f"missed {what}")
        for what in self.wrong:
            print(f"WRONG {what}")
        if not self.wrong:
            print("every number is right")
        raise SystemExit(self.code)


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
