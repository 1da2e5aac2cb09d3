"""Common parts of the commands: declaration, shared options, printing of results.

Takes: a function with the parameters of a command; a result.
Gives: `command`, `option`, `argument`; `picture_option`, `result_option`, `seed_option`, `WholeNumber`;
`criterion_with`; `print_result`, `echo`, `prints_to_stderr`, `note_aside`, `note_typical_hand`.
Guarantees: with --json, one JSON document is printed and nothing else; nothing printed acts on the terminal;
a file that can't be written is refused before anything is computed.
Does not: know any command.
"""

from __future__ import annotations

import contextlib
import inspect
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, visible
from apc.compiler.files import is_stdout
from apc.compiler.number_parsing import plain_int
from apc.compiler.timings import part, record
from apc.output.formatting import full_digits, json_text
from apc.result import Result
from apc.support.renamed import FORMER_OPTIONS
from apc.support.threads import start_single_threaded

# Settings of an option by the annotation of its parameter, unless `option` overrides them.
FILE = {"type": click.Path(path_type=Path), "metavar": "FILE"}
BY_TYPE: dict[str, dict[str, Any]] = {
    "bool": {"is_flag": True},
    "str": {"default": ""},
    "tuple[str, ...]": {"multiple": True},
    "Path | None": FILE,
    "Path": {**FILE, "required": True},
}


class Option(click.Option):
    """An option whose help has the default in brackets, and no bounds of numbers."""

    def get_help_extra(self, ctx: click.Context) -> Any:
        """Return the parts of the help in brackets."""
        extra = super().get_help_extra(ctx)
        extra.pop("range", None)
        if isinstance(self.show_default, str):
            extra["default"] = self.show_default
        return extra


def option(text: str, metavar: str | None = None, *, name: str = "", **settings: Any) -> Any:
    """Return a function that makes the click option of a parameter; it is the parameter's default value.

    Parameters
    ----------
    text
        The option's help.
    metavar
        The placeholder of its value in the help.
    name
        The option's name; by default `--` and the parameter's name.
    settings
        Arguments of click's `Option`; they override those of the parameter's annotation (`BY_TYPE`).
    """

    def make(parameter: inspect.Parameter) -> click.Parameter:
        option_settings = {
            **BY_TYPE.get(parameter.annotation, {}),
            **({"metavar": metavar} if metavar else {}),
        }
        option_settings = {"show_default": bool(settings.get("default")), **option_settings, **settings}
        return Option(
            [name or f"--{parameter.name.replace('_', '-')}", parameter.name], help=text, **option_settings
        )

    return make


def argument(**settings: Any) -> Any:
    """Return a function that makes the click argument of a parameter; `settings` are click's `Argument`'s."""
    return lambda parameter: click.Argument([parameter.name], **settings)


def picture_option(text: str, more: Sequence[str] = ()) -> Any:
    """Return an option that names a picture to write, or a file with a suffix of `more`."""

    def check(_: click.Context, requested: click.Parameter, path: Path | None) -> Path | None:
        if path is not None:
            from apc.output.pictures import check_picture

            check_picture(path, requested.opts[0], more)
        return path

    return option(text, callback=check)


def result_option() -> Any:
    """Return the option `--out` of a result that can be drawn, tabulated, or written as JSON."""
    text = "Output: .png .svg .pdf .csv .parquet .json."
    return picture_option(text, (".csv", ".parquet", ".json"))


def seed_option() -> Any:
    """Return the option `--seed` of packet losses and delays."""
    text = "Random seed."
    return option(text, "N", type=WholeNumber(0, 2**63 - 1), show_default="experiment: seed")


# The options and arguments of parameters without a default, by name.
SHARED: dict[str, Callable[[inspect.Parameter], click.Parameter]] = {
    "file": argument(required=False),
    "settings": option("Set a parameter (repeatable).", 'PATH="VALUE UNIT"', name="--set"),
    "criterion": option(
        "nominal, or mean-square (default if lossy).",
        "CRITERION",
        name="--criterion",
        type=click.Choice(("mean-square", "nominal")),
    ),
    "hands": option("Operator model, see analyze.", "HANDS", default="free"),
    "operating_point": option(
        "start or equilibrium.",
        "POINT",
        type=click.Choice(("start", "equilibrium")),
        default="start",
    ),
    "duration": option("Duration.", '"TIME"', show_default="experiment: duration"),
    "as_json": option("Print JSON instead of text.", name="--json"),
}


DIGITS = Option(
    ["--digits"],
    type=click.Choice(("6", "full")),
    default="6",
    show_default=True,
    help="Digits; full adds error bounds.",
)


def command(function: Callable[..., None]) -> Command:
    """Return a function `NAME_command` as the command of that name, its options in their order."""
    requested = inspect.signature(function).parameters.values()
    made = [
        (SHARED[parameter.name] if parameter.default is parameter.empty else parameter.default)(parameter)
        for parameter in requested
    ]
    if "as_json" in inspect.signature(function).parameters:
        made.append(DIGITS)
    made.append(Option(["--timings"], is_flag=True, help="Print the time of each step on stderr."))
    name = function.__name__.removesuffix("_command")
    return Command(name, callback=function, params=made, help=inspect.cleandoc(function.__doc__ or ""))


def criterion_with(hands: str, criterion: str | None) -> str | None:
    """Return the criterion of --criterion and --hands. Raises ApcError E930 if they are incompatible."""
    if hands != "passive":
        return criterion
    if criterion == "mean-square":
        message = "--criterion mean-square is not available with --hands passive (nominal network only)"
        raise ApcError(
            Diagnostic("E930", SourceLocation("--hands"), message, fix="--criterion nominal --hands passive")
        )
    return "passive"


class Command(click.Command):
    """A command with the options --timings and, where it prints a result, --digits."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the words of a command line. Raises click.UsageError with the present name of a former
        option.
        """
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            present = (FORMER_OPTIONS[""] | FORMER_OPTIONS.get(self.name or "", {})).get(error.option_name)
            if not any(present in parameter.opts for parameter in self.params):
                raise
            message = f"unknown option {error.option_name}; its present name is {present}."
            raise click.UsageError(message, ctx) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command with one thread of each library, its parts measured if that is asked for."""
        start_single_threaded()
        with full_digits() if ctx.params.pop("digits", "") == "full" else contextlib.nullcontext():
            return self._timed(ctx) if ctx.params.pop("timings") else super().invoke(ctx)

    def _timed(self, ctx: click.Context) -> Any:
        """Run the command and print the time of each part at the end."""
        started = time.process_time()
        with record() as timings:
            try:
                return super().invoke(ctx)
            finally:
                ctx.call_on_close(lambda: echo(timings_text({"start": started, **timings}), err=True))


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
def print_result(
    result: Result, *, as_json: bool, written: Iterable[Path | None] = (), names_files: bool = False
) -> None:
    """Print a result, as text or as one JSON document, and the names of its files.

    Parameters
    ----------
    result
        The result.
    as_json
        Whether to print JSON, without other text.
    written
        The written files, or None; if one is stdout, the text is printed on stderr.
    names_files
        Whether the text of the result names the files itself.
    """
    files = [path for path in written if path is not None]
    err = prints_to_stderr(*files)
    echo(json_text(result.to_dict()) if as_json else str(result), err=err)
    if files and not as_json and not names_files:
        echo("\n" + "\n".join(f"{path} is written" for path in files), err=err)


def prints_to_stderr(*outputs: Path | None) -> bool:
    """Return whether texts are printed on stderr, because an output file is stdout."""
    return any(output is not None and is_stdout(output) for output in outputs)


def note_aside(text: str) -> None:
    """Print a note on stderr."""
    echo(f"note: {text}", err=True)


def note_typical_hand(hands: str) -> None:
    """Print a note that the typical values of a library hand are used instead of the measured ranges."""
    from apc.lifting.devices import HANDS

    if hands not in HANDS:
        note_aside(f"{hands}: typical values are used; apc analyze uses the measured ranges")


def echo(text: str, *, err: bool = False) -> None:
    """Print a text, with characters that would act on the terminal written out."""
    click.echo(visible(text), err=err)


def timings_text(timings: Mapping[str, float]) -> str:
    """Return the table of --timings: the steps and their durations."""
    rows = [*timings.items(), ("all", sum(timings.values()))]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name:<{width}}  {seconds * 1e3:8.1f} ms" for name, seconds in rows)
