"""Other values of what is compiled: names, what depends on them, groups, columns, and what is refused."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model, counts_peers
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.overrides import Override, apply, parse_override
from apc.parameter_values.parameter_names import ParameterRef, find, is_named
from apc.parameter_values.parameters import resolve
from apc.studies.batch_analysis import analyze_many
from apc.studies.margins import margins
from tests.topologies import AVERAGE, MESH, TOPOLOGIES, compiled, library, replaced


def _value(model: Model, name: str, group: int = 0) -> float:
    return float(resolve(model).parameters[group][0, model.peer_types[0].parameters.index(name)])


def _column(model: Model, name: str) -> list[float]:
    """Return a parameter's value of each peer of the first group."""
    numbers = resolve(model)
    return [
        float(value)
        for value in numbers.parameters[0][numbers.rows[0], model.peer_types[0].parameters.index(name)]
    ]


@pytest.mark.parametrize("name", ["contact.stiffness", "couplers.contact.stiffness"])
def test_an_override_reaches_every_group_or_the_one_named(name: str) -> None:
    model = compiled(
        replaced(
            AVERAGE,
            ("user: {count: 3}", "left: {count: 1, set: {contact.stiffness: 7 N/m}}\n  right: {count: 1}"),
        )
    )
    override = parse_override(model, f"{name}=0.8 N/mm")
    assert override == Override(ParameterRef("contact.stiffness"), Fraction(800))
    changed = apply(model, [override])
    assert [_value(changed, "contact.stiffness", group) for group in (0, 1)] == [800.0, 800.0]
    changed = apply(model, [parse_override(model, "left.contact.stiffness=0.8 N/mm")])
    assert _value(changed, "contact.stiffness", 1) == _value(model, "contact.stiffness", 1) != 800.0


@pytest.mark.parametrize("name", ["device.mass", "user.device.mass"])
def test_an_override_replaces_a_column(name: str) -> None:
    model = compiled(replaced(AVERAGE, ("{count: 3}", "{set: {device.mass: [0.1 kg, 0.2 kg, 0.1 kg]}}")))
    changed = apply(model, [parse_override(model, f"{name}=0.5 kg")])
    assert _column(changed, "device.mass") == [0.5, 0.5, 0.5]
    stored = apply(model, [parse_override(model, "contact.stiffness=5 N/m")])
    assert _column(stored, "device.mass") == [0.1, 0.2, 0.1]


THIRDS = """\
topology: thirds
clocks: {haptic: 1 ms, network: 8 ms}
parameters: {ratio: 5/3, base: 4.8 ms}
peers: {user: {count: 3}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}
  coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}
links: {lan: {clock: network, delay: base*ratio}}
"""


@pytest.mark.parametrize("setting", ["base=4.8 ms", "ratio=5/3"])
def test_a_time_that_depends_on_a_third_stays_the_very_tick(setting: str) -> None:
    """4.8 ms · 5/3 is 8 ms: a packet that came 2e-19 s later would miss its tick."""
    model = compiled(THIRDS)
    changed = apply(model, [parse_override(model, setting)])
    assert resolve(changed).timings["lan.delay"] == Fraction(8, 1000)


@pytest.mark.few(4)
@pytest.mark.parametrize("topology", sorted(path.name for path in TOPOLOGIES.glob("*.yaml")))
def test_setting_a_number_to_what_it_is_changes_nothing(topology: str) -> None:
    model = compile_topology(TOPOLOGIES / topology)
    before = resolve(model)
    for row in apc.parameters(model).rows:
        if row.follows or row.fixed or row.low != row.high or math.isnan(row.low):
            continue
        written = before.timings.get(row.name, Fraction(repr(row.low)))
        after = resolve(apc.set_parameters(model, {row.name: written}))
        assert after.timings == before.timings, row
        for one, other in zip(after.parameters, before.parameters, strict=True):
            assert np.array_equal(one, other), row


OUTER = """\
component: Outer
connectors: {a: Flange, b: Flange}
parameters: {k: {unit: N/m}, lag: {unit: s, default: 1 ms}, slack: {unit: s, default: 0 s}, clock: clock}
parts:
  inner: {type: SampledSpringDamper, a: a, b: b, stiffness: 2*k, clock: clock, delay: lag + slack}
"""


NESTED = """\
topology: nested
clocks: {haptic: 1 ms, slow: 2 ms}
peers: {one: {count: 1}, two: {count: 2, set: {o.k: 7 N/m, o.lag: 2 ms, o.clock: slow}}}
masses: {device: {mass: 0.1 kg}, cube: {mass: 0.1 kg}}
couplers: {o: {type: Outer, a: device, b: cube, k: 1 N/m, clock: haptic}}
"""


@pytest.mark.parametrize(
    ("settings", "stiffness", "delays"),
    [
        ([], (2, 14), (1, 2)),
        (["o.k=3 N/m"], (6, 6), (1, 2)),
        (["two.o.k=3 N/m"], (2, 6), (1, 2)),
        (["o.lag=5 ms"], (2, 14), (5, 5)),
        (["two.o.lag=5 ms"], (2, 14), (1, 5)),
        (["o.lag=5 ms", "two.o.lag=3 ms"], (2, 14), (5, 3)),
        (["two.o.lag=3 ms", "o.lag=5 ms"], (2, 14), (5, 3)),
        (["o.slack=1 ms"], (2, 14), (2, 3)),
    ],
)
def test_what_a_group_sets_of_a_part_reaches_the_parts_inside(
    tmp_path: Path, settings: list[str], stiffness: tuple[int, int], delays: tuple[int, int]
) -> None:
    model = compiled(NESTED, library(tmp_path, OUTER))
    changed = apply(model, [parse_override(model, text) for text in settings])
    numbers = resolve(changed)
    peer_types = [changed.peer_types[group.peer_type] for group in changed.groups]
    rows = zip(peer_types, numbers.parameters, strict=True)
    assert [row[0, peer_type.parameters.index("o.inner.stiffness")] for peer_type, row in rows] == list(
        stiffness
    )
    assert [numbers.timings[peer_type.holds[0].delay] * 1000 for peer_type in peer_types] == list(delays)
    assert [peer_type.holds[0].clock for peer_type in peer_types] == ["haptic", "slow"]


def test_what_depends_on_a_column_is_worked_out_peer_by_peer(tmp_path: Path) -> None:
    law = ("2*k", '"if k > rest and k < 9*rest then 3*max(k, 2*rest) else -(-k)/2"')
    part = replaced(OUTER, law, ("{k: {unit: N/m}", "{k: {unit: N/m}, rest: {unit: N/m, default: 2 N/m}"))
    text = replaced(
        NESTED,
        ("{one: {count: 1}, two: {count: 2, set: {o.k: 7 N/m", "{two: {set: {o.k: [1 N/m, 3 N/m, 7 N/m]"),
    )
    model = compiled(text, library(tmp_path, part))
    assert _column(model, "o.inner.stiffness") == pytest.approx([0.5, 12.0, 21.0], rel=1e-15)
    less = apply(model, [parse_override(model, "o.rest=0.5 N/m")])
    assert _column(less, "o.inner.stiffness") == pytest.approx([3.0, 9.0, 3.5], rel=1e-15)


@pytest.mark.whole
def test_what_is_set_for_all_groups_says_what_each_of_them_has(capsys: pytest.CaptureFixture[str]) -> None:
    """The star's teacher holds on with 400 N/m of its own, its students with the part's 100 N/m."""
    reported = (
        "arm.stiffness has one value for all groups here; the topology has 400 N/m at teacher, 100 N/m "
        "at student"
    )
    star = compile_topology(TOPOLOGIES / "star-lecture.yaml")
    assert reported in analyze_many(star, {"arm.stiffness": [100.0, 400.0]}).limitations
    assert run(["analyze", str(TOPOLOGIES / "star-lecture.yaml"), "--set", "arm.stiffness=100 N/m"]) == 0
    assert capsys.readouterr().err == f"note: {reported}\n"


@pytest.mark.whole
def test_what_the_compiler_counts_or_adds_is_nobody_s_to_set() -> None:
    """A hold without delay, one by an expression, and how many are heard have names that mean nothing."""
    own = compiled(replaced(AVERAGE, ("link: lan}", "link: lan, delays: own}")))
    star = compiled(replaced(MESH, ("delay: 8 ms}", "delay: 8 ms, graph: star}")))
    for model in (own, star):
        names = [one.name for one in (*model.parameters, *model.timings)]
        unnamed = [name for name in names if not is_named(name)]
        assert unnamed
        for name in unnamed:
            with pytest.raises(ApcError, match="E623" if counts_peers(name) else "E622"):
                find(model, name)
        assert all(is_named(row.parameter) for row in margins(numeric_model(model)).rows)
    with pytest.raises(ApcError, match=r"E623 user.count is a number of peers and can't be varied here"):
        find(own, "user.count")
    five = apply(own, [parse_override(own, "user.count=5")])
    assert five.groups[0].count == 5
