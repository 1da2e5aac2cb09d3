"""Claims about answers over an unreliable network: what commands print, what they find, what they refuse.

Reference numbers: independent programs (brute force over all patterns of loss, matrix-free second moments) on
the scene of Rakhsha and Constantinescu, Fig. 2.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.regions.axes import parse_axes
from apc.regions.region import region
from tests.lossy import unreliable
from tests.topologies import AVERAGE, compiled


@pytest.fixture(name="folder")
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(folder: Path, more: str, *changes: tuple[str, str]) -> str:
    text = unreliable(more)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "s.yaml").write_text(text, encoding="utf-8")
    return "s.yaml"


def document(words: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    assert run([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_an_ideal_network_has_no_verdict_of_its_own(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.yaml").write_text(AVERAGE, encoding="utf-8")
    assert document(["analyze", "s.yaml"], capsys)["network"] is None
    assert apc.judge_network(compiled(AVERAGE)) is None
    assert apc.judge_network(compiled(unreliable("loss: 0 %, jitter: 0 ms"))) is None


def test_the_verdict_over_the_network_stands_in_the_json(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = document(["analyze", written(folder, "loss: 10 %")], capsys)["network"]
    assert found["verdict"] == "stable in mean square"
    assert found["stable"] is True
    assert found["exact"] is True
    # The reference is known to 5e-11.
    assert abs(found["mean_square_radius"] - 0.9136364756784219) <= 5e-11 + found["error"]
    assert found["error"] < 1e-9
    assert found["almost_sure"] is None  # what settles in mean square settles almost surely
    assert found["losses_in_a_row"]["certified"] == 1  # the references' certified_L
    assert {"proof", "rms_error_m", "notes"} <= set(found)


def test_what_grows_in_mean_square_is_told_almost_surely_too(folder: Path) -> None:
    found = apc.judge_network(compiled(unreliable("loss: 10 %")), set={"coordination.stiffness": "1300 N/m"})
    assert found is not None
    assert found.verdict == "unstable in mean square"
    assert found.almost_sure is not None
    low, high = found.almost_sure.interval
    assert 0 < low < found.almost_sure.exponent < high < np.log(found.mean_square_radius or 0.0) / 2
    assert str(found).startswith("three-users-average: unstable in mean square\n")
    assert max(map(len, str(found).splitlines())) <= 80
    assert folder.exists()


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("more", "value"),
    [
        ("loss: 10 %", 1143.224858916119),
        ("loss: 10 %, on_loss: hold", 1143.224858916119),
        ("loss: 20 %, on_loss: zero", 1354.3615910782753),
        ("loss: 1 %, on_loss: zero", 1106.987087497751),
    ],
)
def test_the_largest_stable_stiffness_is_that_of_the_references(more: str, value: float) -> None:
    found = apc.critical(
        compiled(unreliable(more)), "coordination.stiffness", lower="900 N/m", upper="1600 N/m"
    )
    assert found.criterion == "mean-square"
    assert found.left_out == ()
    assert found.value is not None
    assert found.error is not None
    # The references' radii are known to 3e-10 and change by some 1.6e-4 a N/m.
    assert abs(found.value - value) <= 2e-6 + found.error
    assert found.stable_side == "below"


@pytest.mark.parametrize(
    ("more", "proof"),
    [
        ("loss: 10 %", "second moments bounded on either side"),
        ("loss: {p: 1 %, r: 10 %}", "second moments by iteration in floats, not proved"),
    ],
)
def test_a_crossing_claims_no_more_than_its_moments_do(more: str, proof: str) -> None:
    system = compiled(unreliable(more).replace("count: 3", "count: 2"))
    found = apc.critical(system, "coordination.stiffness", lower="1100 N/m", upper="1500 N/m")
    assert [one.proof for one in found.crossings] == [proof]


def test_loss_is_a_parameter_like_others(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stiff = ("stiffness: 500 N/m", "stiffness: 1143.224858916119 N/m")
    words = ["critical", "lan.loss", written(folder, "loss: 5 %", stiff), "--lower", "2 %", "--upper", "20 %"]
    found = document(words, capsys)
    # What is just stable at 10 % needs 10 %: losses make this scene stiffer.
    assert abs(found["value"] - 0.1) <= 1e-8
    assert found["stable_side"] == "above"
    nominal = document([*words[:1], "coordination.stiffness", "s.yaml", "--in", "nominal"], capsys)
    assert nominal["criterion"] == "nominal"
    assert abs(nominal["value"] - 1096.4108683656323) <= 1e-6


def test_what_is_lost_may_vary_from_nothing_on() -> None:
    found = apc.sweep(compiled(unreliable("loss: 0 %")), {"lan.loss": "0,10 %"}, jobs=1)
    np.testing.assert_allclose(
        found.column("mean_square_radius"), [0.9161770691168368, 0.9136364756784219], rtol=1e-9
    )


def test_a_boundary_over_loss_is_not_flat(folder: Path) -> None:
    system = compiled(unreliable("loss: 10 %"))
    axes = parse_axes(system, "lan.loss=0 %:40 %", "coordination.stiffness=1000 N/m:1500 N/m")
    found = region(system, axes, cells=3)
    assert found.criterion == "mean-square"
    (curve,) = found.curves
    ends = dict(sorted(map(tuple, curve.points[[0, -1]].tolist())))
    # The references: 1096.4 without losses, 1384 at 40 %.
    np.testing.assert_allclose(list(ends.values()), [1096.4108683656323, 1383.5619], rtol=1e-6)
    assert curve.mode == "mean-square"
    assert np.isnan(curve.frequency_hz).all()
    assert found.contains(0.3, 1200.0)
    assert not found.contains(0.05, 1200.0)
    assert found.left_out == ()
    assert str(found).splitlines()[1] == "  stable in mean square, over the network as it is"
    assert found.plot().get_title() == "stable in mean square, over the network"
    assert folder.exists()


def test_a_sweep_over_loss_is_of_the_network_as_it_is() -> None:
    found = apc.sweep(compiled(unreliable("loss: 10 %")), {"lan.loss": "0,10 %"}, jobs=1)
    np.testing.assert_allclose(
        found.column("mean_square_radius"), [0.9161770691168368, 0.9136364756784219], rtol=1e-9
    )
    nominal = apc.sweep(
        compiled(unreliable("loss: 10 %")),
        {"contact.stiffness": "1000 N/m,1001 N/m"},
        jobs=1,
        criterion="nominal",
    )
    assert "spectral_radius" in nominal.headings


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ("loss: 100 %", "lan loses everything"),
        ("loss: {p: 1 %, r: 0 %}", "never end (r = 0)"),
        ("loss: 1 %, jitter: 9 ms, reorder: all", "overtaken and count all the same"),
        ("loss: 1 %, jitter: 1 ms, on_loss: zero", "together with on_loss: zero"),
        ("loss: {p: 1 %, r: 10 %}, jitter: 1 ms", "jitter and bursts of lan"),
        ("jitter: 24 ms", "covariances of luck that drive loops of"),
    ],
)
def test_what_is_not_served_is_refused_by_name(more: str, why: str) -> None:
    system = compiled(unreliable(more))
    found = apc.judge_network(system)
    assert found is not None
    assert (found.verdict, found.stable, found.mean_square_radius) == ("not judged", None, None)
    assert why in found.notes[0]
    with pytest.raises(apc.ApcError, match="E898 the scene can't be judged in mean square") as error:
        apc.critical(system, "coordination.stiffness")
    assert error.value.mistakes[0].hint == "--in nominal"


def test_a_share_that_cannot_be_judged_is_not_sent_to_the_nominal_network() -> None:
    with pytest.raises(apc.ApcError, match=r"E898 .* lan loses everything") as error:
        apc.critical(compiled(unreliable("loss: 1 %")), "lan.loss", lower="99 %", upper="100 %")
    assert error.value.mistakes[0].hint == "a narrower range between --lower and --upper"


def test_a_delay_is_not_varied_in_mean_square() -> None:
    with pytest.raises(apc.ApcError, match=r"E898 lan\.delay can't be varied in mean square"):
        apc.critical(compiled(unreliable("loss: 1 %")), "lan.delay")


def test_a_jitter_longer_than_the_delay_arrives_at_once_at_the_earliest() -> None:
    """Uniform over 1 … 15 ms or 0 … 16 ms; of 9 ms, one in eighteen would arrive before it was sent."""
    found = [apc.judge_network(compiled(unreliable(f"jitter: {ms} ms"))) for ms in (7, 8, 9)]
    radii = [one.mean_square_radius for one in found if one is not None]
    assert len(radii) == len(found)
    assert all(one is not None and one.stable for one in found)
    assert len(set(radii)) == len(radii)


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("more", "stiffness", "proof"),
    [
        ("loss: 10 %", 500, "proved stable in mean square, by floats whose every rounding is bounded"),
        ("loss: 10 %", 1200, "proved unstable in mean square, by floats whose every rounding is bounded"),
        (
            "loss: 10 %, on_loss: zero",
            500,
            "proved stable in mean square, by floats whose every rounding is bounded",
        ),
        ("loss: {p: 1 %, r: 10 %}", 500, ""),
    ],
)
def test_a_proof_is_told_where_it_is_asked_for(more: str, stiffness: int, proof: str) -> None:
    values = {"coordination.stiffness": f"{stiffness} N/m"}
    system = compiled(unreliable(more))
    asked, plain = (apc.judge_network(system, set=values, certify=one) for one in (True, False))
    assert asked is not None
    assert plain is not None
    assert (asked.proof, plain.proof) == (proof, "")
    assert any(text.startswith("not proved") for text in asked.notes) == (not proof)


def test_a_scene_that_is_not_linear_is_judged_about_its_start_and_says_so() -> None:
    text = unreliable("loss: 10 %").replace("type: SampledSpringDamper", "type: OneSidedContact")
    found = apc.judge_network(compiled(text))
    assert found is not None
    assert found.linearized
    assert str(found).splitlines()[0].endswith(", linearized at its start")


@pytest.mark.parametrize(
    ("more", "stiffness", "said"),
    [
        ("loss: 10 %", "500 N/m", "  losses in a row  any pattern of at most 1 is certified harmless"),
        ("loss: 10 %", "1090 N/m", "  losses in a row  not even one at a time is certified harmless"),
        ("loss: 10 %", "1500 N/m", "  losses in a row  with none a motion grows by 1.03224 a frame"),
    ],
)
def test_what_is_said_of_losses_fits_their_number_and_the_line(more: str, stiffness: str, said: str) -> None:
    found = apc.judge_network(compiled(unreliable(more)), set={"coordination.stiffness": stiffness})
    lines = str(found).splitlines()
    assert said in lines
    assert max(map(len, lines)) <= 80


def test_how_soon_bursts_end_is_scanned_from_where_they_end(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(folder, "loss: {p: 1 %, r: 10 %}", ("count: 3", "count: 2"))
    found = document(["critical", "lan.loss.r", path], capsys)
    assert found["verdict"].startswith("stable")
    assert found["crossings"] == []
    assert run(["critical", "coordination.damping", path, "--lower", "10 N*s/m", "--upper", "400 N*s/m"]) == 0
    assert "–" not in capsys.readouterr().out  # second moments have no frequency
