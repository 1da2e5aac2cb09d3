"""Claims about `apc.frame.names`."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.__main__ import run
from apc.analysis.analysis import analyze
from apc.compiler.compiled import counts_peers
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.frame.names import (
    Free,
    find,
    is_named,
    named_times,
    notes_for_all_groups,
    parameter_of,
    unit_of,
)
from apc.frame.overrides import Override, apply
from apc.regions.axes import parse_axes
from apc.regions.region import region
from apc.vary.evaluator import free_parameters
from apc.vary.many import analyze_many
from apc.vary.margins import margins
from apc.vary.sensitivity import sensitivities
from tests.sites import grouped, paper
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("contact.stiffness", Free("contact.stiffness")),
        ("couplers.contact.stiffness", Free("contact.stiffness")),
        ("links.lan.delay", Free("lan.delay")),
        ("left.contact.stiffness", Free("contact.stiffness", "left")),
    ],
)
def test_a_name_may_start_with_its_group_or_its_section(written: str, meant: Free) -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 2, {}))
    assert find(system, written) == meant


def test_a_misspelt_name_gets_the_nearest_real_one_and_the_number_of_peers_is_none() -> None:
    with pytest.raises(
        ApcError, match=r"E622 contact.stifness is no parameter of paper. Write: contact.stiff"
    ):
        find(paper(), "contact.stifness")
    with pytest.raises(ApcError, match="E623 peers is a number of peers"):
        find(paper(), "peers")


def test_a_free_parameter_is_its_groups_own_if_the_group_sets_it() -> None:
    system = grouped(paper(), ("left", 1, {"contact.stiffness": 7.0}), ("right", 1, {}))
    for group, value in (("left", 7.0), ("right", 1000.0), (None, 1000.0)):
        assert parameter_of(system, Free("contact.stiffness", group)).value == value
    assert Free("contact.stiffness", "left").label == "left.contact.stiffness"
    assert (unit_of(system, "contact.stiffness"), unit_of(system, "lan.delay")) == ("N/m", "s")


def test_what_the_compiler_counts_or_adds_is_nobody_s_to_set() -> None:
    """A hold without delay, one by an expression, and how many are heard have names that mean nothing."""
    own = compiled(replaced(AVERAGE, ("link: lan}", "link: lan, delays: own}")))
    star = compiled(replaced(MESH, ("delay: 8 ms}", "delay: 8 ms, graph: star}")))
    for system in (own, star):
        names = [one.name for one in (*system.parameters, *system.timings)]
        unnamed = [name for name in names if not is_named(name)]
        assert unnamed
        for name in unnamed:
            with pytest.raises(ApcError, match="E623" if counts_peers(name) else "E622"):
                find(system, name)
        assert all(is_named(one.name) for one in (*free_parameters(system), *named_times(system)))
        rows = [one.parameter for one in margins(system).rows]
        rows += [one.parameter for one in sensitivities(system).rows]
        assert rows
        assert all(is_named(name) for name in rows)


def test_the_derivatives_of_a_star_are_those_of_its_radius() -> None:
    """Of a scene whose peers hear different numbers of others, by differences of the radius itself."""
    star = compiled(replaced(MESH, ("delay: 8 ms}", "delay: 8 ms, graph: star}")))
    rows = {one.parameter: one for one in sensitivities(star).rows}
    for name in ("coordination.stiffness", "contact.stiffness", "device.mass"):
        value = parameter_of(star, Free(name)).value
        ends = [
            analyze(apply(star, [Override(Free(name), Fraction(value * (1 + way * 1e-5)))])).spectral_radius
            for way in (1, -1)
        ]
        assert rows[name].derivative == pytest.approx((ends[0] - ends[1]) / (2e-5 * value), rel=1e-4)


@pytest.mark.parametrize("written", ["count(lan)", "user.count(lan)"])
def test_how_many_peers_are_heard_is_no_parameter_to_set(written: str) -> None:
    with pytest.raises(
        ApcError,
        match=r"E623 .* how many peers are heard, by their weights",
    ):
        find(compiled(MESH), written)


def test_what_is_set_for_all_groups_says_what_each_of_them_has(capsys: pytest.CaptureFixture[str]) -> None:
    """The star's teacher holds on with 400 N/m of its own, its students with the part's 100 N/m."""
    told = (
        "arm.stiffness is one value for all groups here; the scene has 400 N/m at teacher, 100 N/m at student"
    )
    star = compile_topology(SCENES / "star-lecture.yaml")
    assert notes_for_all_groups(star, [Free("arm.stiffness"), Free("arm.damping")]) == [told]
    assert not notes_for_all_groups(star, [Free("arm.stiffness", "student")])
    assert told in analyze_many(star, {"arm.stiffness": [100.0, 400.0]}).left_out
    axes = parse_axes(star, "arm.stiffness=90 N/m:110 N/m", "student.contact.stiffness=700 N/m:900 N/m")
    assert told in region(star, axes, cells=2).left_out
    assert run(["analyze", str(SCENES / "star-lecture.yaml"), "--set", "arm.stiffness=100 N/m"]) == 0
    assert capsys.readouterr().err == f"note: {told}\n"
