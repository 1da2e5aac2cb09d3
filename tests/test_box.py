"""Claims about `apc.analysis.box` and `apc.analysis.box_proof`."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apc.analysis.analysis import analyze
from apc.analysis.box import parse_range
from apc.analysis.box_proof import BoxProof, prove_box
from apc.answer import answer
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.vary.critical import critical
from tests.sites import columned, derived, grouped, paper
from tests.topologies import AVERAGE, ONE_MASS, SCENES, compiled, library, replaced

TRANSLATING = "stable up to a common translation"


def _proof(system: CompiledSystem, *texts: str) -> BoxProof:
    return prove_box(system, [parse_range(system, text) for text in texts])


def _message(system: CompiledSystem, *texts: str) -> str:
    with pytest.raises(ApcError) as caught:
        _proof(system, *texts)
    [mistake] = caught.value.mistakes
    return f"{mistake.code} {mistake.sentence}"


@pytest.mark.parametrize(
    "texts",
    [
        ["contact.stiffness=±1%"],
        ["contact.stiffness=±10%", "coordination.stiffness=+-10 %"],
        ["coordination.stiffness=100 N/m:1 N/mm"],
        ["device.mass=±2%", "cube.mass=±2%", "cube.damping=±5%"],
        ["couplers.contact.damping=0 N*s/m:0.5 N*s/m"],
    ],
)
def test_a_box_is_proved_and_every_point_of_it_is_stable(texts: list[str]) -> None:
    system = compiled(AVERAGE)
    ranges = [parse_range(system, text) for text in texts]
    found = prove_box(system, ranges)
    assert (found.stable, found.verdict, found.open_share) == (True, TRANSLATING, 0.0)
    generator = np.random.default_rng(5)
    for _ in range(5):
        shares = [Fraction(float(one)) for one in generator.choice([0.0, 1.0, 0.3, 0.77], len(ranges))]
        point = [
            Override(one.free, one.low + share * (one.high - one.low))
            for one, share in zip(ranges, shares, strict=True)
        ]
        assert analyze(apply(system, point)).stable


def test_a_box_beyond_the_limit_is_unstable_at_a_point_and_one_below_it_is_stable() -> None:
    """The limit of K_T at K_C = 1000 is 1096.411 N/m."""
    system = compiled(AVERAGE)
    below = _proof(system, "coordination.stiffness=1050 N/m:1096.4 N/m")
    assert below.stable is True
    above = _proof(system, "coordination.stiffness=1050 N/m:1096.5 N/m")
    assert above.stable is False
    [point] = above.point
    assert 1096.41 < point <= 1096.5
    assert analyze(apply(system, [Override(Free("coordination.stiffness"), Fraction(point))])).stable is False
    assert "proved unstable at" in str(above)


def test_an_instability_inside_the_box_is_found() -> None:
    """The contact alone allows 1865 N/m: the point is found between the middle and the end."""
    found = _proof(compiled(AVERAGE), "contact.stiffness=1 N/m:3000 N/m")
    assert found.stable is False
    assert found.point[0] > 1800


def test_an_open_box_stands_first_and_says_that_more_cells_may_decide_it() -> None:
    system = compiled(AVERAGE)
    box = [parse_range(system, "coordination.stiffness=100 N/m:1 N/mm")]
    text = str(answer(system, box=box, cells=1))
    assert text.startswith("three-users-average:\nundecided, 100 % of the box is left open (2 cells)")
    assert "--cells 20\n" in text
    assert str(answer(system, box=box)).startswith("three-users-average:\nproved stable")


@settings(max_examples=8, deadline=None)
@given(share=st.floats(0.05, 0.9), width=st.floats(0.01, 0.2))
def test_a_box_across_the_boundary_is_never_proved_and_one_below_it_holds_no_unstable_point(
    share: float, width: float
) -> None:
    system = compiled(AVERAGE)
    largest = critical(system, "coordination.stiffness").value
    assert largest is not None
    across = _proof(system, f"coordination.stiffness={largest * (1 - width)} N/m:{largest * (1 + width)} N/m")
    assert not across.stable
    low, high = largest * share, largest * min(share + width, 0.98)
    below = _proof(system, f"coordination.stiffness={low} N/m:{high} N/m", "device.mass=±0.5%")
    assert below.stable
    middle = Override(Free("coordination.stiffness"), Fraction((low + high) / 2))
    assert analyze(apply(system, [middle])).stable


def test_what_can_not_be_proved_is_left_open_and_says_where(monkeypatch: pytest.MonkeyPatch) -> None:
    """At K_T = 0 nothing ties the copies: no box that holds this point is stable in the same sense."""
    monkeypatch.setattr("apc.analysis.box_proof.MOST_CELLS", 100)
    found = _proof(compiled(AVERAGE), "coordination.stiffness=0 N/m:200 N/m")
    assert (found.stable, found.verdict) == (None, "undecided")
    assert 0 < found.open_share < 0.1
    assert 0 < found.point[0] < 20
    assert max(len(line) for line in str(found).splitlines()) <= 80
    assert found.to_dict()["open_around"] == list(found.point)


def test_what_depends_on_a_parameter_by_an_expression_follows() -> None:
    text = replaced(
        AVERAGE,
        ("peers:", "parameters: {kt: 500 N/m, unit: 2 N/m}\npeers:"),
        ("stiffness: 500 N/m", "stiffness: kt*kt/unit/(peers + 247)"),
    )
    system = compiled(text)
    [value] = [one.value for one in system.parameters if one.name == "coordination.stiffness"]
    assert value == 500
    assert _proof(system, "kt=490 N/m:510 N/m").stable is True
    limit = (1096.411 * 500) ** 0.5  # kt²/500 = 1096.411
    assert _proof(system, f"kt={limit * 0.99} N/m:{limit * 0.9999} N/m").stable is True
    assert _proof(system, f"kt={limit * 0.99} N/m:{limit * 1.0001} N/m").stable is False


def test_a_group_of_its_own_is_opened_alone_even_if_it_is_alike_in_the_middle() -> None:
    system = grouped(
        paper(), ("left", 2, {"contact.stiffness": 1000.0}), ("right", 1, {"contact.stiffness": 1000.0})
    )
    found = _proof(system, "left.contact.stiffness=±5%")
    assert found.stable is True
    assert found.ranges[0].free.group == "left"
    unstable = _proof(system, "left.contact.stiffness=1000 N/m:2500 N/m")
    assert unstable.stable is False


def test_groups_of_the_same_numbers_are_opened_over_the_same_range() -> None:
    """They are alike on the diagonal of the box, and nowhere else."""
    system = grouped(
        paper(), ("left", 2, {"contact.stiffness": 1000.0}), ("right", 1, {"contact.stiffness": 1000.0})
    )
    found = _proof(system, "left.contact.stiffness=±5%", "right.contact.stiffness=±5%")
    assert (found.stable, len(found.ranges)) == (True, 2)


def test_peers_that_differ_in_other_things_are_proved_together() -> None:
    system = columned(paper(), device__mass=[0.1, 0.2, 0.15])
    assert _proof(system, "contact.stiffness=±1%").stable is True


def test_drifts_and_jumping_directions_are_left_open_with_a_reason() -> None:
    system = paper(kt=0.0, bt=0.0)
    loose = grouped(system, ("user", 3, {"device.damping": 0.0, "cube.damping": 0.0}))
    found = _proof(loose, "contact.stiffness=±1%")
    assert found.stable is not True


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("contact.stiffness", "E830"),
        ("contact.stiffness=900 N/m", "E830"),
        ("contact.stiffness=±1", "E830"),
        ("contact.stiffness=±x%", "E830"),
        ("contact.stiffness=±0%", "E833"),
        ("contact.damping=±1%", "E833 contact.damping is 0, and any share of it is 0 as well"),
        (
            "contact.stiffness=5 N/m:1 N/m",
            "E833 the box of contact.stiffness wants a low below the high, got 5 N/m to 1 N/m",
        ),
        ("contact.stiffness=-5 N/m:1 N/m", "E833"),
        ("device.mass=0 kg:1 kg", "E833"),
        ("lan.delay=±1%", "E831 lan.delay is a time"),
        ("peers=±1%", "E623"),
        ("contact.stiffnes=±1%", "E622"),
        ("contact.stiffness=900:1100", "E204"),
        ("contact.stiffness=900 kg:1100 kg", "E204"),
    ],
)
def test_a_box_that_can_not_be_is_refused_in_one_message(text: str, message: str) -> None:
    found = _message(compiled(AVERAGE), text)
    assert found.startswith(message) and "Write: contact.stiffness: " not in found


def test_a_parameter_opened_twice_or_of_many_values_is_refused() -> None:
    system = compiled(AVERAGE)
    assert _message(system, "contact.stiffness=±1%", "contact.stiffness=±2%").startswith("E831")
    many = columned(paper(), device__mass=[0.1, 0.2, 0.15])
    assert _message(many, "device.mass=±1%").startswith("E831 device.mass is not the same for all")
    assert _message(many, "user.device.mass=±1%").startswith("E831 device.mass differs from peer to peer")


def test_scenes_that_are_no_rational_function_of_the_parameter_are_refused() -> None:
    bent = compiled((SCENES / "experiment-average.yaml").read_text(encoding="utf-8"))
    assert _message(bent, "contact.stiffness=±1%").startswith("E832")
    system = derived(paper(), coordination__stiffness="sqrt(kt)")
    assert _message(system, "kt=±1%") == (
        "E832 coordination.stiffness = sqrt(kt) takes sqrt() of a parameter that is left open."
    )


def test_what_a_box_does_not_ask_for_may_be_no_rational_function() -> None:
    system = derived(paper(), coordination__stiffness="if peers > 2 then kt else sqrt(kt)/(peers - 3)")
    assert _proof(system, "kt=±1%").stable is True
    divided = derived(paper(), coordination__stiffness="kt/(peers - 3)")
    assert _message(divided, "kt=±1%") == "E832 coordination.stiffness = kt/(peers - 3) divides by zero."


def test_a_memory_that_nobody_reads_is_no_translation_of_a_box(tmp_path: Path) -> None:
    part = """\
component: Sum
about: A spring, and a sum of errors that nothing reads while ki is 0.
connectors: {a: Flange, b: Flange}
parameters: {k: {unit: N/m}, ki: {unit: N/m}, clock: clock}
variables: {s: {unit: m, start: 0 m}}
equations:
  - s = previous(s) + sample(a.x) - sample(b.x)
  - a.f = hold(k*(sample(a.x) - sample(b.x)) + ki*s)
  - b.f = -a.f
"""
    text = ONE_MASS.replace("peers:", "clocks: {tick: 1 ms}\npeers:", 1)
    text += "couplers:\n  own: {type: Sum, a: device, b: ground, k: 100 N/m, ki: 0 N/m, clock: tick}\n"
    system = compiled(text, library(tmp_path, part))
    found = _proof(system, "own.k=±1%")
    assert (found.verdict, found.stable) == ("stable", True)
    assert analyze(system).verdict == "stable"
