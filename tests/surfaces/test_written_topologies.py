"""A topology with other values: it compiles to these, and every other number and line is as it was."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import pytest

import apc
from apc.app.yaml_edit import with_values, write_topology
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.parameter_values.overrides import apply, parse_override
from apc.parameter_values.parameter_listing import parameters
from apc.parameter_values.parameter_names import find
from tests.commands import Cli, write
from tests.topologies import TOPOLOGIES

HEAD = """# äöü 😀
topology: t
clocks: {haptic: 1 ms, network: 8 ms}
"""
COUPLERS = """couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}
  coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, link: lan} # keep
"""
LINKS = "links: {lan: {clock: network, delay: 8 ms}}\n"
MASSES = """masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube:   {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
"""
USERS = "peers: {user: {count: 2}}\n"
K, CONTACT = "coordination.stiffness", "contact.stiffness"


def changed(text: str, values: Mapping[str, str], tmp_path: Path) -> tuple[str, Model]:
    """Return a text with other values, and what it compiles to; no other number of any group is changed.

    The numbers of both are compared as `apc show --parameters` lists them, which the writer does not use.
    """
    path = tmp_path / "t.yaml"
    path.write_bytes(text.encode())
    model = apc.compile(path)
    new = with_values(text, model, {find(model, name, counts=True): value for name, value in values.items()})
    path.write_bytes(new.encode())
    written = apc.compile(path)
    meant = listed(apply(model, [parse_override(model, f"{n}={v}") for n, v in values.items()]))
    names = {name for name in (*meant, *listed(written)) if name.count(".") > 1}
    assert {name: listed(written).get(name) for name in names} == {name: meant.get(name) for name in names}
    return new, written


def listed(model: Model) -> dict[str, tuple[float, float]]:
    """Return the range of each number by name, one of all groups once for each group."""
    rows = {row.name: (row.low, row.high) for row in parameters(model).rows}
    names = [group.name for group in model.groups]
    whole = {name: span for name, span in rows.items() if name.partition(".")[0] not in names}
    return {f"{name}.{label}": span for name in names for label, span in whole.items()} | rows


def lines_changed(old: str, new: str) -> int:
    before, after = old.splitlines(), new.splitlines()
    assert len(before) == len(after)
    return sum(map(str.__ne__, before, after))


ALIASES = {
    "an alias of a number": (
        HEAD + USERS + MASSES + COUPLERS.replace("500 N/m", "*k").replace("1000 N/m", "&k 1000 N/m") + LINKS,
        K, {K: 800.0, CONTACT: 1000.0}, 1,
    ),
    "the number that an alias repeats": (
        HEAD + USERS + MASSES + COUPLERS.replace("500 N/m", "*k").replace("1000 N/m", "&k 1000 N/m") + LINKS,
        CONTACT, {K: 1000.0, CONTACT: 800.0}, 2,
    ),
    "an alias of a mapping": (
        HEAD + USERS + "masses:\n  device: &d {mass: 0.1 kg, damping: 5 N*s/m}\n  cube: *d # two\n"
        + COUPLERS + LINKS,
        "cube.damping", {"cube.damping": 7.0, "device.damping": 5.0}, 1,
    ),
    "the mapping that aliases repeat": (
        HEAD + USERS + "masses:\n  device: &d\n    mass: &m 0.1 kg\n    damping: 5 N*s/m # one\n  cube: *d\n"
        "  third: *d\n" + COUPLERS + LINKS,
        "device.damping", {"cube.damping": 5.0, "device.damping": 7.0, "third.damping": 5.0}, 3,
    ),
    "an alias inside an alias": (
        HEAD + USERS + "masses:\n  device: &d {mass: &m 0.1 kg, damping: 5 N*s/m}\n"
        "  cube: &c {mass: *m, damping: &e 4 N*s/m}\n"
        "  third: *c\n  fourth: {mass: *m, damping: *e}\n" + COUPLERS + LINKS,
        "third.mass", {"cube.mass": 0.1, "device.mass": 0.1, "third.mass": 0.7, "fourth.mass": 0.1}, 1,
    ),
    "an alias of a group": (
        HEAD + "peers: {one: &g {count: 1, set: {coordination.stiffness: 300 N/m}}, two: *g}\n"
        + MASSES + COUPLERS + LINKS,
        f"two.{K}", {f"two.{K}": 800.0, f"one.{K}": 300.0}, 1,
    ),
    "what groups set themselves, for all": (
        HEAD
        + "peers: {one: &g {count: 1, set: {coordination.stiffness: 300 N/m}}, two: *g, three: {count: 1}}\n"
        + MASSES + COUPLERS + LINKS,
        K, {K: 800.0}, 2,
    ),
    "a value for each peer": (
        HEAD + "peers: {one: {set: {coordination.stiffness: [300 N/m, 400 N/m]}}}\n"
        + MASSES + COUPLERS + LINKS,
        K, {K: 800.0}, 2,
    ),
}  # fmt: skip
UNITS = {"stiffness": "N/m", "damping": "N*s/m", "mass": "kg"}


@pytest.mark.parametrize(("text", "name", "expected", "lines"), ALIASES.values(), ids=ALIASES)
def test_a_value_that_several_places_share_changes_at_one_of_them(
    text: str, name: str, expected: dict[str, float], lines: int, tmp_path: Path
) -> None:
    quantity = name.rpartition(".")[2]
    new, written = changed(text, {name: f"{expected[name]} {UNITS[quantity]}"}, tmp_path)
    rows = listed(written)
    for group in written.groups:
        at = {label if label in rows else f"{group.name}.{label}": value for label, value in expected.items()}
        assert {label: rows[label] for label in at} == {label: (value, value) for label, value in at.items()}
    assert lines_changed(text, new) == lines and text.count("#") == new.count("#")


BLOCK = """couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}
  coordination:
    type: AveragePosition
    object: cube
    clock: haptic
    link: lan
    stiffness: STYLE
"""
STYLES = {
    "literal": "|-\n      500 N/m\n",
    "literal with a comment": "|   # why\n      500 N/m\n\n",
    "folded": ">+\n      500\n      N/m\n\n\n# after it\n",
    "quoted": '"500 N/m"   # why\n',
    "single quotes over lines": "'500\n      N/m'\n",
    "plain over lines": "500\n      N/m\n",
    "tagged": "!!str 500 N/m\n",
    "an anchor nobody uses": "&a 500 N/m\n",
}


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("style", STYLES.values(), ids=STYLES)
def test_a_scalar_of_any_style_is_replaced_and_comments_stay(style: str, end: str, tmp_path: Path) -> None:
    text = HEAD + USERS + MASSES + BLOCK.replace("STYLE\n", style) + LINKS
    text = text.replace("\n", end).replace(f"count: 2}}}}{end}", f"count: 2}}}}\t# a tab{end}")
    new, written = changed(text, {K: "812.5 N/m", "device.damping": "6 N*s/m"}, tmp_path)
    assert listed(written)[f"user.{K}"] == (812.5, 812.5) and "stiffness: 812.5 N/m" in new
    assert new.count("#") == text.count("#") and new.count(end) == new.count("\n")


def test_what_is_missing_is_added_without_touching_comments(tmp_path: Path) -> None:
    text = (
        HEAD
        + USERS.replace("count: 2", "count: 2, # several\n  ")
        + MASSES
        + BLOCK.replace("STYLE", "500 N/m  # why")
    )
    text += LINKS
    values = {"coordination.damping": "2 N*s/m", "haptic.phase": "0.5 ms", "user.device.mass": "0.2 kg"}
    new, _ = changed(text, values, tmp_path)
    assert "    stiffness: 500 N/m  # why\n    damping: 2 N*s/m\n" in new
    assert "haptic: {period: 1 ms, phase: 0.5 ms}" in new and "# several\n" in new


def test_a_list_below_its_key_becomes_a_number(tmp_path: Path) -> None:
    text = (
        HEAD
        + USERS
        + MASSES
        + COUPLERS
        + "links:\n  lan:\n    clock: network\n    delay:\n    - 4 ms\n    - 9 ms\n"
    )
    new, written = changed(text, {"lan.delay": "8 ms"}, tmp_path)
    assert new.endswith("clock: network\n    delay: 8 ms\n") and not written.within


def test_a_text_that_would_be_another_topology_is_refused_and_not_written(tmp_path: Path) -> None:
    (tmp_path / "users.csv").write_text("device.mass [kg]\n0.1\n0.2\n", encoding="utf-8")
    text = HEAD + "peers: {user: {table: users.csv}}\n" + MASSES + COUPLERS + LINKS
    path, out = tmp_path / "t.yaml", tmp_path / "o.yaml"
    path.write_text(text, encoding="utf-8")
    out.write_text("mine", encoding="utf-8")
    model = apc.compile(path)
    with pytest.raises(ApcError, match=r"E702 device\.mass is given both by set and by the table"):
        write_topology(out, text, model, {find(model, "device.mass"): "0.3 kg"})
    (tmp_path / "else").mkdir()
    with pytest.raises(ApcError, match=r"users\.csv"):  # which is not beside what is written
        write_topology(tmp_path / "else" / "o.yaml", text, model, {find(model, K): "400 N/m"})
    assert out.read_text(encoding="utf-8") == "mine" and not list((tmp_path / "else").iterdir())


@pytest.mark.few(5)
@pytest.mark.parametrize("path", sorted(TOPOLOGIES.glob("*.yaml")), ids=lambda path: path.stem)
def test_of_every_number_of_every_shipped_topology_only_that_one_changes(path: Path) -> None:
    """The writer compiles what it wrote and compares every number, or raises."""
    model, text = apc.compile(path), path.read_text(encoding="utf-8")
    columns = {column.name for group in model.groups for column in group.columns}  # of a table
    written = 0
    for row in parameters(model).rows:
        value = Fraction(repr(row.low)) * Fraction(11, 10) or Fraction(1, 8)
        if row.name.endswith(".count"):
            value = Fraction(row.low) + 1
        if (
            row.fixed
            or row.name.partition(".")[2] in columns
            or (row.maximum is not None and value > row.maximum)
        ):
            continue
        quantity = f"{float(value):.9g} {row.unit}".removesuffix(" 1")
        try:
            override = parse_override(model, f"{row.name}={quantity}")
            apply(model, [override])
        except ApcError:
            continue  # of two numbers that are one only together, as phase and period
        new = with_values(text, model, {override.free: quantity})
        written += 1
        assert sum(line not in text.splitlines() for line in new.splitlines()) <= len(model.groups) + 1
    assert written


def test_tune_writes_the_topology_that_it_proved(cli: Cli) -> None:
    text = (
        HEAD
        + USERS
        + "masses:\n  device: &d {mass: 0.1 kg, damping: 5 N*s/m}\n  cube: *d\n"
        + COUPLERS
        + LINKS
    )
    write("t.yaml", text)
    words = "--free 'cube.damping=1 N*s/m:20 N*s/m' --maximize cube.damping --hands held"
    assert (
        cli(f"tune t.yaml {words} --set 'hand.mass=0.1 kg' --set 'lan.delay=4 ms' --write o.yaml").code == 0
    )
    rows = listed(apc.compile("o.yaml"))
    assert rows["user.cube.damping"] == (20.0, 20.0) and rows["user.device.damping"] == (5.0, 5.0)
    assert rows["lan.delay"] == (0.004, 0.004)


def test_gains_that_can_not_be_written_are_shown_with_the_reason(cli: Cli) -> None:
    write("users.csv", "device.mass [kg]\n0.1\n0.2\n")
    write("t.yaml", HEAD + "peers: {user: {table: users.csv}}\n" + MASSES + COUPLERS + LINKS)
    Path("else").mkdir()
    ran = cli(f"tune t.yaml --free '{K}=10 N/m:100 N/m' --maximize {K} --write else/o.yaml")
    assert ran.code == 1 and "100 N/m is the largest" in ran.out and "users.csv" in ran.err
    assert not Path("else/o.yaml").exists()
