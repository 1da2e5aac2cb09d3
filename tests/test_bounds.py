"""Claims about `apc.frame.bounds`."""

from __future__ import annotations

import pytest

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.frame.overrides import apply, parse_override
from apc.frame.parameters import resolve
from tests.sites import columned, derived, grouped, paper


def _message(system: CompiledSystem, text: str) -> str:
    with pytest.raises(ApcError) as caught:
        apply(system, [parse_override(system, text)])
    [mistake] = caught.value.mistakes
    return f"{mistake.code} {mistake.sentence}"


def test_a_group_out_of_bounds_is_named() -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 1, {}))
    assert _message(system, "left.cube.mass=-1 kg") == "E624 left.cube.mass wants more than 0 kg, got -1 kg."


def test_a_peer_out_of_bounds_or_without_a_value_is_named() -> None:
    system = columned(paper(), device__mass=[0.1, 0.0, 0.1])
    assert _message(system, "contact.stiffness=5 N/m") == (
        "E624 user[2].device.mass wants more than 0 kg, got 0 kg."
    )
    heavy = columned(
        derived(paper(), coordination__stiffness="kt*(2 - cube.mass)"), cube__mass=[1.0, 1.0, 3.0]
    )
    assert _message(heavy, "contact.stiffness=5 N/m") == (
        "E624 user[3].coordination.stiffness wants at least 0 N/m, got -500 N/m."
    )
    divided = columned(derived(paper(), coordination__stiffness="kt/cube.mass"), cube__mass=[0.1, 0.1, 0.0])
    with pytest.raises(
        ApcError, match=r"E331 coordination.stiffness = kt/cube.mass has no finite value for user"
    ):
        resolve(divided)
