"""What stands beside the verdict: it comes from the same scene, and never changes the verdict."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

from apc.analysis.analysis import analyze, prepare
from apc.analysis.box import parse_range
from apc.answer import answer, judge, sensitivities_of
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.frame.names import Free
from apc.frame.overrides import Override, apply, parse_override
from tests.topologies import AVERAGE, ROOT, SCENES, replaced

FLIPS = ROOT / "tests" / "scenes" / "verdict-hangs-on-the-order.yaml"


def test_the_verdict_is_that_of_the_analysis_alone() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    found, alone = answer(system), analyze(system)
    assert found.analysis.verdict == alone.verdict
    assert found.analysis.modes == alone.modes
    assert found.contact_modes is None  # nothing switches in it
    assert found.to_dict()["spectral_radius"] == alone.spectral_radius


def test_a_json_answer_holds_what_stands_beside_the_verdict() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    found = json.loads(json.dumps(answer(system).to_dict(), allow_nan=False))
    margin = {one["parameter"]: one for one in found["margins"]}["coordination.stiffness"]
    assert margin["value"] == pytest.approx(1096.411, rel=1e-6)  # the limit derived for this scene
    assert found["sensitivities"]["derivatives"][0]["parameter"] == "device.damping"
    assert found["warnings"] == []
    assert "conventions" not in found and "box" not in found


def test_a_verdict_that_hangs_on_a_convention_is_warned_of() -> None:
    system = compile_topology(FLIPS)
    found = answer(system)
    assert found.to_dict()["warnings"] == [found.conventions.warning]
    assert "Warning: the verdict hangs on a convention" in str(found)
    assert all(len(line) <= 80 for line in str(found).splitlines())


def test_a_scene_with_contact_says_which_mode_is_unstable() -> None:
    text = str(answer(compile_topology(SCENES / "experiment-average.yaml")))
    assert "unstable when on at no peer or on at right" in text
    assert all(len(line) <= 80 for line in text.splitlines())


def test_a_box_and_a_proof_stand_below_the_answer() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    ranges = [parse_range(system, "contact.stiffness=±1%")]
    found = answer(system, certify=True, box=ranges, every_convention=True)
    assert found.analysis.proof.startswith("proved stable")
    assert found.box is not None and found.box.stable
    assert {"conventions", "box"} <= found.to_dict().keys()


def test_the_method_of_the_paper_agrees_and_proves_nothing() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    assert judge(system, method="paper").spectral_radius == pytest.approx(
        judge(system).spectral_radius, abs=1e-12
    )
    with pytest.raises(ApcError, match="E850 method paper gives no proof"):
        judge(system, method="paper", certify=True)


def test_packet_loss_is_said_to_be_out_of_the_verdict(tmp_path: Path) -> None:
    path = tmp_path / "lossy.yaml"
    path.write_text(replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 2 %}")), encoding="utf-8")
    notes = " ".join(analyze(compile_topology(path)).left_out)
    assert "lan" in notes and "every packet takes the nominal 8 ms" in notes


def test_a_delay_of_a_thousand_frames_has_its_verdict_and_says_what_it_has_not() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    late = apply(system, [parse_override(system, "lan.delay=8 s")])
    found = answer(late)
    assert found.analysis.verdict == analyze(late).verdict
    text = str(found)
    assert "what moves it most: not looked for: 3 peers make one system of 2,006" in text
    assert "margins none: the scene is not stable as it is" in text
    assert all(len(line) <= 80 for line in text.splitlines())


def test_numbers_that_leave_the_range_of_floats_beside_the_verdict_are_said_so() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    text = str(answer(apply(system, [parse_override(system, "device.mass=1e-300 kg")])))
    assert "what moves it most: not looked for: the present values have no frame" in text


def test_a_stiffness_of_zero_lets_copies_apart_and_the_rest_is_told_all_the_same() -> None:
    """Three users without coordination: what is free between them decides nothing."""
    system = compile_topology(SCENES / "three-users-average.yaml")
    alone = apply(system, [parse_override(system, "coordination.stiffness=0 N/m")])
    found = answer(alone)
    assert found.analysis.rigid_modes == 3
    assert found.sensitivities.radius == pytest.approx(found.analysis.spectral_radius, abs=1e-12)
    step = Fraction(1, 10**6)
    moved = [
        analyze(apply(alone, [Override(Free("device.mass"), Fraction(1, 10) + side)])).spectral_radius
        for side in (-step, step)
    ]
    slope = {row.parameter: row.derivative for row in found.sensitivities.rows}["device.mass"]
    assert slope == pytest.approx((moved[1] - moved[0]) / float(2 * step), rel=1e-5)
    margin = {row.parameter: row.value for row in found.margins.rows}["coordination.stiffness"]
    assert margin == pytest.approx(1096.411, rel=1e-6)  # what holds below it with any stiffness


def test_derivatives_of_a_matrix_whose_digits_are_lost_are_not_told() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    prepared = prepare(system)
    found = analyze(system, prepared=prepared)
    assert sensitivities_of(system, prepared, found).rows
    other = replace(found, spectral_radius=found.spectral_radius + 1e-10)
    told = sensitivities_of(system, prepared, other)
    assert told.rows == ()
    assert told.note.startswith("what moves it most: not told: floats lose the digits")


@pytest.mark.few(4)
@pytest.mark.parametrize(
    "name", ["three-users-mesh", "three-users-average", "two-users-waves", "lossy-average"]
)
@pytest.mark.parametrize(
    "values",
    [
        {"coordination.stiffness": "1e12 N/m"},
        {"contact.stiffness": "0 N/m", "contact.damping": "0 N*s/m"},
        {"device.mass": "1e-12 kg"},
        {"device.damping": "1e9 N*s/m"},
        {"lan.delay": "1 s"},
    ],
    ids=str,
)
def test_a_table_that_is_empty_says_why(name: str, values: dict[str, str]) -> None:
    system = compile_topology(SCENES / f"{name}.yaml")
    known = {one.name for one in (*system.parameters, *system.timings)}
    overrides = [parse_override(system, f"{one}={value}") for one, value in values.items() if one in known]
    found = answer(apply(system, overrides))
    listed = [found, *([found.network] if found.network else [])]
    for one in listed:
        for table in (one.sensitivities, one.margins):
            assert table.rows or table.note
            assert str(table).strip()
