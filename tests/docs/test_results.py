"""The reference of results has exactly the fields of the JSON documents, with their types."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import fields
from typing import Any, NamedTuple

import pytest

from apc.analysis.box_result import ChangingDelay
from apc.analysis.contact_modes import ContactMode, ContactModes
from apc.analysis.one_sided_slopes import SideVerdict
from apc.extensions.switching.arbitrary_switching import ArbitrarySwitching
from apc.extensions.switching.describing_function import Predicted
from apc.extensions.switching.limit_cycle import ContactLimitCycle, LimitCycle, SpectralPeak
from apc.mean_square.loss_results import TopLyapunovExponent
from apc.simulation.monte_carlo import Statistics
from apc.simulation.summary import Broken
from apc.tuning.specification import TransparencyMetric
from apc.tuning.tuner import ActiveConstraint
from tests.commands import Cli
from tests.topologies import ROOT

PAGE = ROOT / "docs" / "reference" / "results.md"
AVERAGE, LOSSY, EXPERIMENT = (
    ROOT / "models" / "topologies" / f"{name}-average.yaml" for name in ("three-users", "lossy", "experiment")
)
BOX = '--box "contact.stiffness=990 N/m:1000 N/m"'
FREE = '--free "coordination.stiffness=10 N/m:1000 N/m" --maximize coordination.stiffness'
AXES = '--x "contact.stiffness=1000 N/m:2000 N/m" --y "coordination.stiffness=400 N/m:500 N/m"'
COMMANDS = {
    "apc analyze": [
        f"{AVERAGE} --event-order {BOX}",
        f"{LOSSY}",
        f"{EXPERIMENT} --operating-point equilibrium --no-margins",
    ],
    "apc analyze --changing": [f"user.count=2:3 {AVERAGE}", f"user.count=2:5 {AVERAGE}"],
    "apc analyze --hands passive": [f"{AVERAGE}"],
    "apc critical": [f"contact.stiffness {AVERAGE}", f"contact.stiffness {LOSSY}"],
    "apc region": [f"{AVERAGE} {AXES}"],
    "apc transparency": [f"{AVERAGE}", f"{LOSSY}"],
    "apc simulate": [f'{AVERAGE} --duration "0.1 s"', f'{LOSSY} --duration "0.1 s"'],
    "apc simulate --runs": [f'2 {LOSSY} --duration "0.1 s"'],
    "apc tune": [f'{AVERAGE} {FREE} --over "user.count=3:4"', f"{LOSSY} {FREE}"],
    "apc compare": [f"{AVERAGE} {LOSSY}"],
}


class Row(NamedTuple):
    """The type and the unit of a field."""

    type: str
    unit: str


Table = dict[str, Row]


def names(cls: Any, *more: str) -> set[str]:
    """Return the names of the fields of a dataclass, and more."""
    return {field.name for field in fields(cls)} | set(more)


# Objects that these topologies do not have, by the classes that they are made of.
OTHERS = {
    ("apc analyze", "sides"): names(SideVerdict),
    ("apc analyze", "network.almost_sure"): names(TopLyapunovExponent),
    ("apc analyze", "contact_modes"): names(ContactModes, "unstable"),
    ("apc analyze", "contact_modes.modes"): names(ContactMode),
    ("apc analyze", "arbitrary_switching"): names(ArbitrarySwitching, "stable"),
    ("apc analyze", "limit_cycle"): names(LimitCycle),
    ("apc analyze", "limit_cycle.predicted"): names(Predicted),
    ("apc analyze", "limit_cycle.lines"): names(SpectralPeak),
    ("apc analyze", "limit_cycle.contacts"): names(ContactLimitCycle),
    ("apc analyze", "box.changing"): names(ChangingDelay),
    ("apc simulate", "decay"): {"rate_per_s", "rate_error_per_s", "time_constant_s", "window_s"},
    ("apc simulate", "oscillation"): {"signal", "peak_to_peak", "frequency_hz", "frequency_error_hz"},
    ("apc simulate", "diverged"): {"signal", "time_s"},
    ("apc simulate", "overshoot"): {"signal", "part"},
    ("apc simulate", "limits_broken"): names(Broken),
    ("apc simulate", "error_estimate"): {"kind", "compared_with", "signals"},
    ("apc simulate", "error_estimate.signals"): {"name", "unit", "error", "relative", "time_s", "range"},
    ("apc simulate", "provenance.tolerances"): {"unit", "relative", "absolute"},
    ("apc simulate --runs", "settled"): names(Statistics, "runs") - {"count"},
    ("apc tune", "delay"): {"parameter", "unit", "range"},
    ("apc tune", "changing"): names(ChangingDelay, "counts"),
    ("apc tune", "transparency_metrics"): names(TransparencyMetric),
    ("apc tune", "active"): names(ActiveConstraint),
}


def tables() -> dict[tuple[str, str], Table]:
    """Return the tables of the page by command and path of the object."""
    found: dict[tuple[str, str], Table] = {}
    command, path = "", ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if heading := re.fullmatch(r"(###?) `(.+)`", line):
            command, path = (heading[2], "") if heading[1] == "##" else (command, heading[2])
            assert (command, path) not in found, line
            found[command, path] = {}
        elif command and line.startswith("| `"):
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            assert len(cells) == 4, line
            for name in re.findall(r"`([^`]+)`", cells[0]):
                assert name not in found[command, path], line
                found[command, path][name] = Row(*cells[1:3])
    return found


TABLES = tables()
Seen = dict[tuple[str, str], set[str]]


def compare(command: str, path: str, value: dict[str, Any], seen: Seen) -> None:
    """Check an object, and all objects in it, against the tables; add the fields to those seen."""
    table = TABLES[command, path]
    assert set(value) <= set(table), (command, path)
    seen.setdefault((command, path), set()).update(value)
    for name, item in value.items():
        kind, or_null, _ = table[name].type.partition(" or null")
        below = f"{path}.{name}".lstrip(".")
        if item is None:
            assert or_null, (command, below)
            continue
        assert is_of(item, kind), (command, below, kind)
        where = command, below
        if same := re.search(r"as `([^`]+)`(?: of `([^`]+)`)?", kind):
            of_command = same[1].startswith("apc ")
            where = (same[1], "") if of_command else (same[2] or command, same[1])
        for each in objects(item, kind):
            compare(*where, each, seen)


def is_of(item: Any, kind: str) -> bool:
    """Whether a value is of a type of the tables."""
    if kind.startswith("list of"):
        inner = kind.removeprefix("list of ")
        one = {"lists": "list", "complex": "complex"}.get(inner, inner.removesuffix("s"))
        return isinstance(item, list) and all(each is None or is_of(each, one) for each in item)
    if kind == "complex":
        return isinstance(item, list) and [*map(type, item)] == [float, float]
    types: dict[str, tuple[type, ...]] = {
        "boolean": (bool,),
        "integer": (int,),
        "number": (int, float),
        "string": (str,),
        "list": (list,),
    }
    if kind in types:
        return isinstance(item, types[kind]) and isinstance(item, bool) == (kind == "boolean")
    assert re.match("(objects? ?|map|as `)", kind), kind
    return isinstance(item, dict)


def objects(item: Any, kind: str) -> Iterator[dict[str, Any]]:
    """Yield the objects of a field that have tables."""
    if kind.startswith("list of objects"):
        yield from item
    elif kind.startswith("map of objects"):
        yield from item.values()
    elif kind.startswith(("object", "as `")):
        yield item


@pytest.mark.parametrize("command", COMMANDS)
def test_the_reference_has_the_fields_of_the_documents(command: str, cli: Cli) -> None:
    seen = {where: {*fields} for where, fields in OTHERS.items() if where[0] == command}
    for words in COMMANDS[command]:
        ran = cli(f"{command.removeprefix('apc ')} {words} --json")
        assert ran.code == 0, ran.err
        compare(command, "", json.loads(ran.out), seen)
    written = {where: set(table) for where, table in TABLES.items() if where[0] == command}
    assert written == {where: fields for where, fields in seen.items() if where[0] == command}


def test_the_reference_has_no_other_command() -> None:
    assert {command for command, _ in TABLES} == set(COMMANDS)


def test_every_number_of_the_reference_has_a_unit() -> None:
    """A number of a mixed list, and of a map, may have none."""
    for where, table in TABLES.items():
        for name, row in table.items():
            if re.match(r"(list of )?number|complex", row.type) and name != "errors":
                assert row.unit, (where, name)
