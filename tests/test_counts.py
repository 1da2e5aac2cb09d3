"""Claims about the number of peers as a number like others: `apc.compiler.crowd`, `apc.vary.counts`."""

from __future__ import annotations

import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem, group_count
from apc.compiler.errors import ApcError
from apc.frame.names import find
from apc.frame.overrides import apply, parse_override
from apc.regions.axes import parse_axes
from apc.regions.region import region
from apc.vary.critical import critical
from apc.vary.many import analyze_many
from apc.vary.margins import margins
from tests.topologies import AVERAGE, MESH, compiled, replaced

NAMED = replaced(
    MESH,
    ("count: 3", "count: 2*n - 1"),
    ("peers:", "parameters: {n: 2, kt: 2000 N/m}\npeers:"),
)
GROUPS = replaced(
    AVERAGE, ("  user: {count: 3}", "  left: {count: 2, set: {device.mass: 0.2 kg}}\n  right: {count: 3}")
)


def _plain(system: CompiledSystem) -> dict[str, object]:
    """Return all of a model but its functions and what it was read from, values as text."""
    groups = [
        (
            group.name,
            group.count,
            {one.name: (one.value, one.exact) for one in group.values},
            {one.name: one.values.tolist() for one in group.columns},
        )
        for group in system.groups
    ]
    parameters = {one.name: (one.value, one.number) for one in system.parameters}
    return {
        "groups": groups,
        "parameters": parameters,
        "timings": [(t.name, t.value) for t in system.timings],
    }


def _with(system: CompiledSystem, *settings: str) -> CompiledSystem:
    return apply(system, [parse_override(system, one) for one in settings])


@pytest.mark.parametrize("count", [2, 3, 7, 40])
@pytest.mark.parametrize(
    "text",
    [
        AVERAGE,
        replaced(MESH, ("delay: 8 ms}", "delay: 8 ms, graph: ring}")),
        replaced(MESH, ("delay: 8 ms}", "delay: 8 ms, graph: star}")),
    ],
    ids=["average", "ring", "star"],
)
def test_a_model_with_another_count_is_the_one_that_compiles(text: str, count: int) -> None:
    changed = _with(compiled(text), f"user.count={count}")
    again = compiled(replaced(text, ("count: 3", f"count: {count}")))
    assert _plain(changed) == _plain(again)


def test_so_it_is_with_groups_and_with_counts_that_follow_from_numbers() -> None:
    changed = _with(compiled(GROUPS), "right.count=9", "left.count=1")
    assert _plain(changed) == _plain(
        compiled(replaced(GROUPS, ("count: 3", "count: 9"), ("count: 2", "count: 1")))
    )
    changed = _with(compiled(NAMED), "n=4")
    assert _plain(changed) == _plain(compiled(replaced(NAMED, ("n: 2", "n: 4"))))
    assert [group.count for group in changed.groups] == [7]


@pytest.mark.parametrize(
    ("text", "setting", "message"),
    [
        (AVERAGE, "user.count=2.5", "E626 user.count wants a whole number from 1 to 1,000,000,000, got 2.5."),
        (
            AVERAGE,
            "user.count=1",
            "E626 the number of all peers wants at least 2: parts follow the others, got 1.",
        ),
        (
            replaced(AVERAGE, ("{count: 3}", "{set: {device.mass: [0.1 kg, 0.2 kg]}}")),
            "user.count=3",
            "E626 device.mass has one value for each of the 2 peers of user: "
            "their count follows from them.",
        ),
        (
            replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, graph: {edges: [[1, 2], [2, 3]]}}")),
            "user.count=4",
            "E626 the graph of lan names its peers: user.count is what it is in the topology.",
        ),
        (
            replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, graph: ring}")),
            "user.count=1000001",
            "E626 user.count wants at most 1,000,000 peers where lan isn't complete, got 1,000,001.",
        ),
        (
            AVERAGE,
            "peers=4",
            "E623 peers is the number of all peers, which follows from the groups'. Write: user.count",
        ),
        (
            NAMED,
            "user.n=4",
            "E622 user.count is one number of the scene, and depends on what is set for user. "
            "Write: the same without the group, or a group with a set of its own",
        ),
    ],
)  # fmt: skip
def test_a_count_that_cannot_be_is_refused(text: str, setting: str, message: str) -> None:
    system = compiled(text)
    with pytest.raises(ApcError) as caught:
        _with(system, setting)
    assert str(caught.value) == f"override: {message}"


@pytest.mark.parametrize(
    ("count", "message"),
    [
        ("count: kt", "scene.yaml:5:23: E204 count wants 1, got kt, which is in N/m. Write: count: 1 1"),
        ("count: m", "count wants a whole number, or an expression over numbers of parameters, got m."),
        ("count: n/2", "count wants a whole number from 1 to 1000000000, got n/2, which is 1.5"),
        ("count: peers", "peers depends on peers, which it is a part of. Write: count: 3"),
        ("count: twice", "twice depends on peers, which it is a part of. Write: count: 3"),
    ],
)
def test_a_count_by_names_is_read_with_care(count: str, message: str) -> None:
    text = replaced(
        MESH, ("count: 3", count), ("peers:", "parameters: {n: 3, kt: 2000 N/m, twice: 2*peers}\npeers:")
    )
    with pytest.raises(ApcError) as caught:
        compiled(text)
    assert message.partition("E204")[2] in str(caught.value)


def test_how_many_users_is_answered_as_each_scene_alone_would() -> None:
    """`critical` over a count against a scene compiled for each: what is stable, and up to where."""
    text = replaced(MESH, ("count: 3", "count: 4"))
    alone = {
        count: bool(analyze(compiled(replaced(MESH, ("count: 3", f"count: {count}")))).stable)
        for count in range(2, 41)
    }
    found = critical(compiled(text), "user.count", lower="2", upper="40")
    stable, verdicts = alone[2], {}
    ends = [int(one.boundary) for one in found.crossings]
    assert ends
    for count in range(2, 41):
        verdicts[count] = stable
        if count in ends:
            stable = not stable
    assert verdicts == alone
    assert found.value is None or alone[int(found.value)]
    assert found.looked <= 39


def test_a_sweep_over_counts_gives_each_scenes_radius() -> None:
    system = compiled(MESH)
    counts = np.array([2, 3, 5, 9])
    found = analyze_many(system, {"user.count": counts})
    for count, radius, error in zip(counts, found.spectral_radius, found.spectral_radius_error, strict=True):
        one = analyze(compiled(replaced(MESH, ("count: 3", f"count: {count}"))))
        assert abs(one.spectral_radius - radius) <= error + one.spectral_radius_error


def test_a_region_over_counts_has_steps_at_each_counts_critical_value() -> None:
    system = compiled(MESH)
    axes = parse_axes(system, "user.count=2:6", "coordination.stiffness=10 N/m:3000 N/m")
    found = region(system, axes)
    for count in range(2, 7):
        crossings = critical(
            _with(system, f"user.count={count}"), "coordination.stiffness", lower="10 N/m", upper="3000 N/m"
        ).crossings
        assert crossings
        for one in crossings:
            for side, off in (("below", -1.0), ("above", 1.0)):
                assert found.contains(count, one.value + off) == (one.stable_side == side)
                assert found.contains(min(count + 0.4, 6), one.value + off) == (one.stable_side == side)


def test_counts_are_asked_for_by_name_only_where_they_vary() -> None:
    system = compiled(NAMED)
    with pytest.raises(ApcError, match=r"E623 user.count is a number of peers, which doesn't vary here"):
        find(system, "user.count")
    assert find(system, "user.count", counts=True).name == group_count("user")
    assert {"n", "user.count"}.isdisjoint(one.parameter for one in margins(system).rows)
