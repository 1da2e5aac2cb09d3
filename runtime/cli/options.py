"""What commands have in common: FILE, the options `--set` and `--json`, and how a result is printed.

Takes: a result.
Gives: `Command`; `file_argument`, `file_option`, `set_option`, `in_option`, `hands_option`,
`duration_option`, `seed_option`, `json_option`, `check_plot`, `criterion_with`, `WholeNumber`;
`print_result`, `tell`, `beside`.
Guarantees: with --json, one JSON document is printed and nothing else; nothing printed acts on the terminal.
Does not: know any command.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from apc.compiler.digits import plain_int
from apc.compiler.errors import ApcError, Mistake, Place, visible
from apc.compiler.files import is_stdout
from apc.compiler.timings import part, record
from apc.present.forms import json_text
from apc.result import Result
from apc.threads import start_single_threaded

Function = TypeVar("Function", bound=Callable[..., None])

file_argument = click.argument("file", required=False)
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar='PATH="VALUE UNIT"',
    help='Change a parameter first, e.g. --set contact.stiffness="800 N/m". May be repeated.',
)
in_option = click.option(
    "--in",
    "criterion",
    type=click.Choice(("mean-square", "nominal")),
    help="What stable means. mean-square: second moments die out over the network as it is, the default "
    "where a link is unreliable; nominal: motions die out if every packet takes its nominal delay.",
)
hands_option = click.option(
    "--hands",
    default="free",
    show_default=True,
    metavar="HANDS",
    help="What holds the devices. free: nothing but what the scene says. clamped: they are held fast. held: "
    "each by a hand of hand.mass, hand.damping and hand.stiffness, 0 unless --set. passive: stable means "
    "stable with all hands that give back no more energy than they got. Or a hand of the library, such as "
    "StylusArmForward.",
)
duration_option = click.option(
    "--duration",
    metavar='"TIME"',
    help='How long, such as "2 s"; that of the scene\'s experiment if not given.',
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")


def file_option(name: str, told: str, *, required: bool = False) -> Callable[[Function], Function]:
    """Return an option that names a file to write; `told` is its help."""
    return click.option(name, type=click.Path(path_type=Path), metavar="FILE", help=told, required=required)


def seed_option(packets: str) -> Callable[[Function], Function]:
    """Return the option `--seed` of what happens by chance to `packets`, such as "that get lost"."""
    return click.option(
        "--seed",
        type=WholeNumber(0, 2**63 - 1),
        metavar="NUMBER",
        help=f"Of packets {packets}; the experiment's if not given.",
    )


def check_plot(plot: Path | None) -> None:
    """Refuse a picture that can't be drawn, before anything is computed."""
    if plot is not None:
        from apc.present.pictures import check_format

        check_format(plot)


def criterion_with(hands: str, criterion: str | None) -> str | None:
    """Return the criterion that --in and --hands together ask for. Raises ApcError E930 where they can't."""
    if hands != "passive":
        return criterion
    if criterion == "mean-square":
        what = "--in mean-square and --hands passive don't go together: hands draw from the nominal network"
        raise ApcError(Mistake("E930", Place("--hands"), what, hint="--in nominal --hands passive"))
    return "passive"


class Command(click.Command):
    """A command that says with --timings how long each of its parts took."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        told = "Say on stderr how long each part took."
        self.params.append(click.Option(["--timings"], is_flag=True, help=told))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command with one thread of each library, its parts measured if that is asked for."""
        start_single_threaded()
        if not ctx.params.pop("timings"):
            return super().invoke(ctx)
        started = time.process_time()
        with record() as taken:
            try:
                return super().invoke(ctx)
            finally:
                ctx.call_on_close(lambda: tell(timings_text({"start": started, **taken}), err=True))


class WholeNumber(click.IntRange):
    """A whole number in ASCII digits, within bounds."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number of a text. Fails as click does if it is none."""
        if isinstance(value, str):
            try:
                value = plain_int(value)
            except ValueError:
                self.fail(f"{value[:40]!r} is not a whole number.", param, ctx)
        return super().convert(value, param, ctx)


@part("print")
def print_result(found: Result, *, as_json: bool, err: bool = False) -> None:
    """Print a result, as one JSON document or in words."""
    tell(json_text(found.to_dict()) if as_json else str(found), err=err)


def beside(*outputs: Path | None) -> bool:
    """Return whether what is printed goes to stderr, as one of the files written is stdout."""
    return any(output is not None and is_stdout(output) for output in outputs)


def note_aside(text: str) -> None:
    """Print a note on what was asked, beside the answer."""
    tell(f"note: {text}", err=True)


def note_usual(hands: str) -> None:
    """Say of a hand of the library that its usual values stand for the range that was measured."""
    from apc.frame.devices import HANDS

    if hands not in HANDS:
        note_aside(f"{hands} by its usual values; apc analyze takes the range that was measured")


def tell(text: str, *, err: bool = False) -> None:
    """Print a text, with characters that would act on the terminal written out."""
    click.echo(visible(text), err=err)


def timings_text(taken: Mapping[str, float]) -> str:
    """Return what --timings says: parts and their seconds."""
    rows = [*taken.items(), ("all", sum(taken.values()))]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name:<{width}}  {seconds * 1e3:8.1f} ms" for name, seconds in rows)
