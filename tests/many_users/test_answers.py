"""The answer as a whole: plain data, the method that serves, what stands beside it, what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from apc.analysis.analysis import analyze, prepare
from apc.analysis.box import parse_range
from apc.analysis.needs import needs
from apc.answer import answer, judge
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.frame.overrides import apply, parse_override
from tests.populations import different
from tests.sites import MS, columned, edged, linked, paper
from tests.topologies import ROOT, SCENES


def test_the_answer_is_plain_data() -> None:
    found = json.loads(json.dumps(analyze(paper()).to_dict(), allow_nan=False))
    assert list(found) == [
        "topology",
        "peers",
        "frame_s",
        "states_per_peer",
        "method",
        "verdict",
        "stable",
        "spectral_radius",
        "spectral_radius_error",
        "rigid_modes",
        "modes",
        "linearized",
        "notes",
        "proof",
        "left_out",
        "translations",
        "rotations",
        "unfelt",
    ]
    assert (found["topology"], found["peers"], found["frame_s"]) == ("paper", 3, 0.008)
    assert (found["states_per_peer"], found["method"], found["stable"]) == (8, "modes", True)
    first = found["modes"][0]
    assert complex(*first["eigenvalue"]) == pytest.approx(
        first["magnitude"] * complex(*first["eigenvalue"]) / abs(complex(*first["eigenvalue"]))
    )
    assert set(first["participation"]) >= {"device.x", "contact.f(-1 ms)", "coordination.x sent(-8 ms)"}


def test_prepared_work_serves_other_numbers_and_other_times() -> None:
    system = paper()
    prepared = prepare(system)
    for text in ("coordination.stiffness=900 N/m", "lan.delay=4 ms", "haptic.period=0.5 ms"):
        changed = apply(system, [parse_override(system, text)])
        assert analyze(changed, prepared=prepared) == analyze(changed)


def test_peers_that_differ_only_at_the_start_are_equal_however_many() -> None:
    many = 10_000
    moved = columned(paper(peers=many), device__x=1e-6 * np.arange(many))
    found = analyze(moved)
    assert (found.method, found.spectral_radius) == ("modes", analyze(paper(peers=many)).spectral_radius)


def test_a_matrix_too_large_is_refused_and_so_is_a_method_that_cannot_serve() -> None:
    with pytest.raises(ApcError, match=r"E804 200 peers make one system of 1,600 states; the matrix of one"):
        analyze(paper(peers=200), method="dense")
    different = columned(linked(paper(), "ring"), device__mass=[0.1, 0.2, 0.3])
    with pytest.raises(ApcError, match=r"E850 method modes can't serve this scene: all peers as one system"):
        analyze(different, method="modes")
    with pytest.raises(ApcError, match=r"E850 method krylov can't serve this scene: user looks at each"):
        analyze(edged(paper()), method="krylov")
    with pytest.raises(ApcError, match=r"E850 method krylov .* all of 600 peers hear each other over lan"):
        analyze(columned(paper(peers=600), device__mass=np.linspace(0.1, 0.2, 600)), method="krylov")
    many = columned(linked(paper(peers=60), "ring"), device__mass=np.linspace(0.1, 0.2, 60))
    with pytest.raises(ApcError, match=r"E850 method determinant .* hear all others over lan"):
        analyze(many, method="determinant")


@pytest.mark.parametrize(
    ("system", "method", "systems"),
    [
        (paper(peers=1_000_000), "modes", ((2, 8),)),
        (columned(paper(), device__mass=[0.1, 0.2, 0.3]), "modes", ((1, 24),)),
        (different(60), "determinant", ((1, 2),)),
        (different(3, graph="ring"), "dense", ((1, 24),)),
        (different(60, graph="ring"), "krylov", ((1, 480),)),
        (linked(paper(peers=100_000), "ring"), "modes", ((50_001, 8),)),
        (paper(comm=8000 * MS), "determinant", ((2, 2),)),
        (paper(comm=80 * MS), "modes", ((2, 26),)),
    ],
)
def test_the_method_is_chosen_by_what_differs(
    system: CompiledSystem, method: str, systems: tuple[tuple[int, int], ...]
) -> None:
    assert (analyze(system).method, needs(system).systems) == (method, systems)


FLIPS = ROOT / "tests" / "scenes" / "verdict-hangs-on-the-order.yaml"


def test_a_verdict_that_hangs_on_a_convention_is_warned_of() -> None:
    system = compile_topology(FLIPS)
    found = answer(system)
    assert found.to_dict()["warnings"] == [found.conventions.warning]
    assert "Warning: the verdict hangs on a convention" in str(found)
    assert all(len(line) <= 80 for line in str(found).splitlines())


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


def test_a_delay_of_a_thousand_frames_has_its_verdict_and_says_what_it_has_not() -> None:
    system = compile_topology(SCENES / "three-users-average.yaml")
    late = apply(system, [parse_override(system, "lan.delay=8 s")])
    found = answer(late)
    assert found.analysis.verdict == analyze(late).verdict
    text = str(found)
    assert "what moves it most: not looked for: 3 peers make one system of 2,006" in text
    assert "margins none: the scene is not stable as it is" in text
    assert all(len(line) <= 80 for line in text.splitlines())


@pytest.mark.few(2)
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
