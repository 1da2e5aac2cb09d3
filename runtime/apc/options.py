"""What commands have in common: the options `--set` and `--json`, and how a result is printed.

Takes: a result. Gives: `set_option`, `json_option`; `print_result`, `print_document`.
Guarantees: with --json, one JSON document is printed and nothing else.
Does not: know any command.
"""

from __future__ import annotations

import json
from typing import Any, Protocol

import click

set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar='PATH="VALUE UNIT"',
    help='Change a parameter first, e.g. --set contact.stiffness="800 N/m". May be repeated.',
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")


class Result(Protocol):
    """What a command finds: it prints itself, and gives itself as plain data."""

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data, ready for JSON."""


def print_result(found: Result, *, as_json: bool) -> None:
    """Print a result, as one JSON document or in words."""
    if as_json:
        print_document(found.to_dict())
    else:
        click.echo(str(found))


def print_document(document: Any) -> None:
    """Print plain data as one JSON document."""
    click.echo(json.dumps(document, ensure_ascii=False, allow_nan=False, indent=2))
