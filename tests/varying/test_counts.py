"""The number of peers as a number like others: set, it gives the topology that compiles with it."""

from __future__ import annotations

import pytest

import apc
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from tests.topologies import AVERAGE, MESH, compiled, replaced

NAMED = replaced(MESH, ("count: 3", "count: 2*n - 1"), ("peers:", "parameters: {n: 2, kt: 2000 N/m}\npeers:"))
GROUPS = replaced(
    AVERAGE, ("  user: {count: 3}", "  left: {count: 2, set: {device.mass: 0.2 kg}}\n  right: {count: 3}")
)
# Weights whose sums are no floats, and a group that only receives.
ROOMS = replaced(
    AVERAGE,
    ("user: {count: 3}", "lab: {count: 2}\n  user: {count: 3}\n  observer: {count: 2}"),
    ("delay: 8 ms}", "delay: 8 ms, graph: {arcs: [[lab, lab, 0.3], [user, user, 0.3], [lab, user, 0.1], "
     "[user, lab, 0.1], [lab, observer], [user, observer, 0.7]]}}"),
)  # fmt: skip
RING, STAR = (replaced(MESH, ("delay: 8 ms}", f"delay: 8 ms, graph: {name}}}")) for name in ("ring", "star"))
EDGES = "{edges: [[1, 2], [2, 3]]}"


def plain(model: Model) -> tuple[object, ...]:
    """Return what a topology is made of and how it moves."""
    groups = [(group.name, group.count) for group in model.groups]
    found = apc.analyze(model)
    modes = [(one.eigenvalue, one.multiplicity, one.family) for one in found.modes]
    return groups, apc.parameters(model).rows, found.peers, found.spectral_radius, modes


@pytest.mark.few(4)
@pytest.mark.parametrize("count", [2, 7, 40])
@pytest.mark.parametrize("text", [AVERAGE, RING, STAR, ROOMS], ids=["average", "ring", "star", "rooms"])
def test_a_model_with_another_count_is_the_one_that_compiles(text: str, count: int) -> None:
    changed = apc.set_parameters(compiled(text), {"user.count": str(count)})
    assert plain(changed) == plain(compiled(replaced(text, ("count: 3", f"count: {count}"))))


def test_so_it_is_with_groups_and_with_counts_that_follow_from_numbers() -> None:
    changed = apc.set_parameters(compiled(GROUPS), {"right.count": "9", "left.count": "1"})
    assert plain(changed) == plain(
        compiled(replaced(GROUPS, ("count: 3", "count: 9"), ("count: 2", "count: 1")))
    )
    changed = apc.set_parameters(compiled(NAMED), {"n": "4"})
    assert plain(changed) == plain(compiled(replaced(NAMED, ("n: 2", "n: 4"))))
    assert [group.count for group in changed.groups] == [7]
    # What a count follows from is no number that a margin could be of.
    assert {"n", "user.count"}.isdisjoint(one.parameter for one in apc.margins(compiled(NAMED)).rows)


@pytest.mark.parametrize(
    ("text", "setting", "message"),
    [
        (
            AVERAGE,
            "user.count=2.5",
            "E626 user.count: expected a whole number from 1 to 1,000,000,000, got 2.5.",
        ),
        (
            AVERAGE,
            "user.count=1",
            "E626 total number of peers: expected at least 2, as a part receives from the other peers, "
            "got 1.",
        ),
        (
            replaced(AVERAGE, ("{count: 3}", "{set: {device.mass: [0.1 kg, 0.2 kg]}}")),
            "user.count=3",
            "E626 device.mass has one value for each of the 2 peers of user; the count can't be changed.",
        ),
        (
            replaced(AVERAGE, ("delay: 8 ms}", f"delay: 8 ms, graph: {EDGES}}}")),
            "user.count=4",
            "E626 the graph of lan lists peers by number; user.count can't be changed. "
            "Name the groups in the graph, as in [user, user].",
        ),
        (
            replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, graph: {arcs: [[user, user]]}}")),
            "user.count=2000",
            "E626 graph: expected at most 2,000,000 arcs, got 4,000,000. Use graph: complete.",
        ),
        (
            RING,
            "user.count=1000001",
            "E626 user.count: expected at most 1,000,000 peers where lan isn't complete, got 1,000,001.",
        ),
        (
            NAMED,
            "user.n=4",
            "E622 user.count is a number of the topology, but depends on a value of user. "
            "Set it without the group, or set a separate value in the group.",
        ),
    ],
)
def test_a_count_that_cannot_be_is_refused(text: str, setting: str, message: str) -> None:
    name, _, value = setting.partition("=")
    with pytest.raises(ApcError) as caught:
        apc.set_parameters(compiled(text), {name: value})
    assert str(caught.value).partition(": ")[2] == message


@pytest.mark.parametrize(
    ("count", "message"),
    [
        ("count: kt", " count: expected a plain number, got kt, which is in N/m."),
        ("count: m", "count: expected a whole number, or an expression in parameters, got m."),
        ("count: n/2", "count: expected a whole number from 1 to 1,000,000,000, got n/2, which is 1.5"),
        ("count: peers", "count peers depends on peers, the sum of all counts."),
        ("count: twice", "count twice depends on peers, the sum of all counts."),
    ],
)
def test_a_count_by_names_is_read_with_care(count: str, message: str) -> None:
    text = replaced(
        MESH, ("count: 3", count), ("peers:", "parameters: {n: 3, kt: 2000 N/m, twice: 2*peers}\npeers:")
    )
    with pytest.raises(ApcError) as caught:
        compiled(text)
    assert message in str(caught.value)


def test_a_mean_over_its_own_group_needs_two_of_them() -> None:
    """One user alone would hear nobody; an observer may be alone."""
    graph = "graph: {arcs: [[user, user], [user, observer]]}"
    text = replaced(
        AVERAGE,
        ("user: {count: 3}", "user: {count: 3}\n  observer: {count: 1}"),
        ("delay: 8 ms}", f"delay: 8 ms, {graph}}}"),
    )
    found = [apc.critical(compiled(text), f"{name}.count", upper=4) for name in ("user", "observer")]
    assert [one.searched_to[0] for one in found] == [2, 1]
