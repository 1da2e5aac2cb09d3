"""Packets lost one by one: what second moments grow by, and what every question then answers.

Reference numbers are of independent programs for the users of Rakhsha and Constantinescu, section III: brute
force over all patterns of loss, and matrix-free second moments. None of them shares anything with `apc`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.mean_square.mean_square_stability import MeanSquareStability
from tests.held_topologies import system_of, topology
from tests.lossy import unreliable
from tests.topologies import AVERAGE, compiled, replaced

ZERO = ", on_loss: zero"

# Losses of 10 %: peers, component, stiffness in N/m, radius under hold and zero, what the program that found
# them was checked to.
INDEPENDENT = (
    (2, "AveragePosition", 500.0, 0.909235650894663, 0.899346342415457, 3.8e-11),
    (2, "AveragePosition", 1100.0, 0.9682986582625207, 0.9605989478619376, 3.1e-10),
    (2, "FullMesh", 500.0, 0.909235650894663, 0.899346342415457, 3.8e-11),
    (3, "AveragePosition", 500.0, 0.9136364756784219, 0.9101263661031651, 4.9e-11),
    (3, "AveragePosition", 1100.0, 0.9935975777202665, 0.9843904600028373, 2.8e-10),
    (3, "FullMesh", 500.0, 0.9790800120367968, 0.9708870450606835, 8.9e-11),
    (3, "FullMesh", 1100.0, 1.1683950922492232, 1.1510627260102633, 2.7e-10),
    (5, "AveragePosition", 500.0, 0.9173074949820015, 0.9138685460523978, 1.7e-12),
    (5, "AveragePosition", 1100.0, 0.9933570578001989, 0.9858302116557474, 1.8e-11),
    (5, "FullMesh", 500.0, 1.1101953815399381, 1.0996800778115228, 3.2e-13),
    (5, "FullMesh", 1100.0, 1.3747843833903768, 1.3615517919385514, 1.7e-12),
)

# Where the radius is 1: peers, mass of a copy in kg, loss, on_loss, stiffness in N/m.
CRITICAL = (
    (2, 0.3, 0.01, "zero", 1242.9958371707935),
    (2, 0.3, 0.1, "hold", 1296.7399790644301),
    (2, 0.3, 0.2, "zero", 1520.180779776873),
    (3, 0.2, 0.01, "zero", 1106.987087497751),
    (3, 0.2, 0.1, "hold", 1143.224858916119),
    (3, 0.2, 0.2, "zero", 1354.3615910782753),
    (5, 0.12, 0.01, "zero", 1111.7216391275529),
    (5, 0.12, 0.1, "hold", 1150.5827059367416),
    (5, 0.12, 0.2, "zero", 1348.1495907856734),
    (10, 0.2, 0.01, "zero", 1859.9989625580474),
    (10, 0.2, 0.1, "hold", 1873.7130364542422),
    (10, 0.2, 0.2, "zero", 2270.988815914956),
    (100, 0.2, 0.01, "zero", 2335.8189216046694),
    (100, 0.2, 0.1, "hold", 2317.2802336831605),
    (100, 0.2, 0.2, "zero", 2883.3293027710033),
    (1_000_000, 0.2, 0.1, "hold", 2375.638867463945),
)

STIFFNESS = "coordination.stiffness"


def decided(text: str, **requested: bool) -> MeanSquareStability:
    found = apc.mean_square_stability(system_of(text), **requested)
    assert found is not None
    return found


def radius(text: str) -> float:
    found = decided(text)
    assert found.mean_square_radius is not None and found.error is not None, found.notes
    assert found.exact and found.error < 1e-7
    assert found.stable is (found.mean_square_radius < 1)
    return found.mean_square_radius


@pytest.mark.needs_extension("loss_models")
@pytest.mark.few(3)
@pytest.mark.parametrize(("peers", "peer_type", "stiffness", "hold", "zero", "digits"), INDEPENDENT)
def test_the_growth_of_second_moments_is_that_of_the_references(
    peers: int, peer_type: str, stiffness: float, hold: float, zero: float, digits: float
) -> None:
    for more, expected in (("", hold), (ZERO, zero)):
        found = radius(topology(peers, stiffness, coupler=peer_type, more=more))
        assert found == pytest.approx(expected, abs=max(digits, 1e-12))


@pytest.mark.needs_extension("loss_models")
@pytest.mark.few(2)
@pytest.mark.parametrize(("peers", "mass", "loss", "on_loss", "stiffness"), CRITICAL)
def test_where_a_reference_is_critical_the_radius_is_1(
    peers: int, mass: float, loss: float, on_loss: str, stiffness: float
) -> None:
    text = topology(peers, stiffness, loss=f"{100 * loss!r} %", more=f", on_loss: {on_loss}")
    found = decided(replaced(text, ("mass: 0.6 kg", f"mass: {mass * peers!r} kg")))
    # d log radius/d stiffness is some 1e-4 m/N, and the reference is right to 1e-9 N/m or so.
    assert found.mean_square_radius == pytest.approx(1, abs=1e-11)
    assert found.error is not None and found.error < 1e-7


def by_critical(model: Model, near: float) -> tuple[float, float]:
    found = apc.critical(model, STIFFNESS, lower="900 N/m", upper="1600 N/m")
    assert (found.criterion, found.limitations, found.stable_side) == ("mean-square", (), "below")
    assert found.value is not None and found.error is not None
    return found.value, found.error


def by_margins(model: Model, near: float) -> tuple[float, float]:
    from apc.lifting.numeric_model import numeric_model
    from apc.studies.margins import Margins, network_margins

    found = network_margins(numeric_model(model), Margins((), ""))
    row = next(row for row in found.rows if row.parameter == STIFFNESS)
    assert row.value is not None and row.error is not None
    assert row.gain_margin == row.value / 500
    return row.value, row.error


def by_sweep(model: Model, near: float) -> tuple[float, float]:
    found = apc.sweep(model, {STIFFNESS: f"{near - 1e-3!r},{near + 1e-3!r} N/m"}, jobs=1)
    assert found.column("verdict").tolist() == ["stable in mean square", "unstable in mean square"]
    return near, 1e-3


def by_box(model: Model, near: float) -> tuple[float, float]:
    below, above = (
        apc.robust_stability(model, {STIFFNESS: f"{low!r} N/m:{high!r} N/m"})
        for low, high in ((near - 1, near - 0.01), (near - 1, near + 0.01))
    )
    assert (below.verdict, above.verdict) == ("stable in mean square", "unstable in mean square")
    return near, 0.01


HOLD_10, ZERO_20 = ("loss: 10 %", 1143.224858916119), ("loss: 20 %, on_loss: zero", 1354.3615910782753)


@pytest.mark.needs_extension("loss_models")
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("method", "more", "stiffness"),
    [
        (by_critical, *HOLD_10),
        (by_critical, *ZERO_20),
        (by_margins, *HOLD_10),
        (by_sweep, *ZERO_20),
        (by_box, *HOLD_10),
    ],
)
def test_every_way_to_ask_finds_the_stiffness_at_which_a_reference_is_critical(
    method: Callable[[Model, float], tuple[float, float]], more: str, stiffness: float
) -> None:
    value, error = method(compiled(unreliable(more)), stiffness)
    # The references' radii are known to 3e-10 and change by some 1.6e-4 a N/m.
    assert abs(value - stiffness) <= 2e-6 + error
    assert error < 0.011


@pytest.mark.whole
def test_a_region_over_loss_ends_where_the_references_do() -> None:
    model = compiled(unreliable("loss: 10 %"))
    found = apc.region(model, x="lan.loss=0 %:40 %", y=f"{STIFFNESS}=1000 N/m:1500 N/m")
    (curve,) = found.curves
    ends = dict(sorted(map(tuple, curve.points[[0, -1]].tolist())))
    # The references: 1096.4 N/m without losses, 1384 N/m at 40 %.
    assert [*ends.values()] == pytest.approx([1096.4108683656323, 1383.5619], rel=1e-6)
    assert (found.criterion, curve.mode, found.limitations) == ("mean-square", "mean-square", ())
    assert found.contains(0.3, 1200.0) and not found.contains(0.05, 1200.0)
    assert str(found).splitlines()[1] == "  criterion: mean-square stability over the lossy network"


def test_loss_is_a_parameter_like_others() -> None:
    """What is just stable at 10 % needs 10 %: losses let this topology be stiffer."""
    text = unreliable("loss: 5 %").replace("stiffness: 500 N/m", "stiffness: 1143.224858916119 N/m")
    found = apc.critical(compiled(text), "lan.loss", lower="2 %", upper="20 %")
    assert found.value == pytest.approx(0.1, abs=1e-8)
    assert found.stable_side == "above"
    swept = apc.sweep(compiled(unreliable("loss: 0 %")), {"lan.loss": "0,10 %"}, jobs=1)
    expected = [0.9161770691168368, 0.9136364756784219]  # the first is the square of the nominal radius
    np.testing.assert_allclose(swept.column("mean_square_radius"), expected, rtol=1e-9)


@pytest.mark.needs_extension("loss_models")
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("peers", "nominal"), [(2, 0.9028182673009955), (3, 0.9161770691168368), (5, 0.9198995414489803)]
)
def test_next_to_no_loss_gives_the_square_of_the_nominal_radius(peers: int, nominal: float) -> None:
    for more in ("", ZERO):
        assert radius(topology(peers, 500.0, loss="1e-12 %", more=more)) == pytest.approx(nominal, rel=1e-11)
    assert apc.mean_square_stability(system_of(topology(peers, 500.0, loss="0 %"))) is None


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("loss", "stiffness", "proved"),
    [
        ("10 %", 500.0, "stable"),
        ("10 %", 1200.0, "unstable"),
        ("10 %, on_loss: zero", 500.0, "stable"),
        ("{p: 1 %, r: 10 %}", 500.0, ""),
    ],
)
def test_a_proof_is_told_where_it_is_asked_for_and_there_is_one(
    loss: str, stiffness: float, proved: str
) -> None:
    text = topology(3, stiffness, loss=loss)
    found = decided(text, certify=True)
    how = f"proved {proved} in mean square, in floating point with rigorous error bounds" if proved else ""
    assert (str(found.proof), str(decided(text).proof)) == (how, "")
    assert any(text.startswith("not proved") for text in found.notes) == (not proved)


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ("loss: 100 %", "every packet of lan is lost"),
        ("loss: {p: 1 %, r: 0 %}", "without end (r = 0)"),
        ("loss: 1 %, jitter: 9 ms, reorder: all", "reordered packets of lan that are accepted"),
        ("loss: 1 %, jitter: 1 ms, on_loss: zero", "together with on_loss: zero"),
        ("loss: {p: 1 %, r: 10 %}, jitter: 1 ms", "jitter and bursts of lan"),
        ("jitter: 24 ms", "covariances of losses and delays with"),
    ],
)
def test_what_is_not_served_is_not_judged_and_says_why(more: str, why: str) -> None:
    model = compiled(unreliable(more))
    found = apc.mean_square_stability(model)
    assert found is not None
    assert (found.verdict, found.stable, found.mean_square_radius) == ("not judged", None, None)
    assert why in found.notes[0]
    with pytest.raises(ApcError, match="E898 no mean-square verdict") as error:
        apc.critical(model, STIFFNESS)
    assert error.value.mistakes[0].fix == "--criterion nominal"


def test_what_cannot_be_varied_is_refused_with_what_can() -> None:
    model = compiled(unreliable("loss: 1 %"))
    with pytest.raises(ApcError, match=r"E898 .* every packet of lan is lost") as error:
        apc.critical(model, "lan.loss", lower="99 %", upper="100 %")
    assert error.value.mistakes[0].advice == "narrow the range"
    with pytest.raises(ApcError, match=r"E898 lan\.delay can't be varied in mean square"):
        apc.critical(model, "lan.delay")
    for name, value in (("lan.loss", "101 %"), ("lan.loss", "-1 %")):
        with pytest.raises(ApcError, match=r"E624 lan\.loss"):
            apc.set_parameters(model, {name: value})


@pytest.mark.whole
def test_the_command_says_what_python_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(unreliable("loss: 10 %"), encoding="utf-8")
    assert run(["analyze", "s.yaml", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["network"]
    # The reference is known to 5e-11.
    assert abs(found["mean_square_radius"] - 0.9136364756784219) <= 5e-11 + found["error"] < 1e-9
    assert (found["verdict"], found["stable"], found["exact"]) == ("stable in mean square", True, True)
    assert found["almost_sure"] is None  # what settles in mean square settles almost surely
    assert found["losses_in_a_row"]["certified"] == 1
    assert {"proof", "rms_error_m", "notes"} <= set(found)
    Path("s.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["analyze", "s.yaml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["network"] is None
