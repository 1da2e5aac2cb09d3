"""Claims about `apc.runtime.frame.names`."""

from __future__ import annotations

import pytest

from apc.compiler.errors import ApcError
from apc.runtime.frame.names import Free, find, parameter_of, unit_of
from tests.sites import grouped, paper
from tests.topologies import MESH, compiled


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("contact.stiffness", ("contact.stiffness", None)),
        ("couplers.contact.stiffness", ("contact.stiffness", None)),
        ("links.lan.delay", ("lan.delay", None)),
        ("left.contact.stiffness", ("contact.stiffness", "left")),
    ],
)
def test_a_name_may_start_with_its_group_or_its_section(written: str, meant: tuple[str, str | None]) -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 2, {}))
    assert find(system, written) == meant


def test_a_misspelt_name_gets_the_nearest_real_one_and_the_number_of_peers_is_none() -> None:
    with pytest.raises(
        ApcError, match=r"E622 contact.stifness is no parameter of paper. Write: contact.stiff"
    ):
        find(paper(), "contact.stifness")
    with pytest.raises(ApcError, match="E623 peers is the number of peers"):
        find(paper(), "peers")


def test_a_free_parameter_is_its_groups_own_if_the_group_sets_it() -> None:
    system = grouped(paper(), ("left", 1, {"contact.stiffness": 7.0}), ("right", 1, {}))
    for group, value in (("left", 7.0), ("right", 1000.0), (None, 1000.0)):
        assert parameter_of(system, Free("contact.stiffness", group)).value == value
    assert Free("contact.stiffness", "left").label == "left.contact.stiffness"
    assert (unit_of(system, "contact.stiffness"), unit_of(system, "lan.delay")) == ("N/m", "s")


@pytest.mark.parametrize("written", ["count(lan)", "user.count(lan)"])
def test_how_many_peers_are_heard_is_no_parameter_to_set(written: str) -> None:
    with pytest.raises(ApcError, match="is how many peers are heard: change a count and compile again"):
        find(compiled(MESH), written)
