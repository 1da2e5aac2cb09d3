"""A topology handed over as a state space: its loop, closed or cut open, opened again by other tools."""

from __future__ import annotations

import functools
import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.exports.lifted import StateSpace, state_space
from tests.topologies import AVERAGE, MESH, TOPOLOGIES, compiled, replaced

Floats = NDArray[np.float64]

# Groups of unlike clocks and delays, contacts, a server, packets heard in the frame they are sent in.
NAMES = (
    "mixed-clocks",
    "experiment-average",
    "client-server",
    "star-lecture",
    "two-users-waves",
    "finger",
    "limited-motor",
    "three-users-scheduled",
)
LATE = AVERAGE.replace("lan: {clock: network, delay: 8 ms}", "lan: {clock: network, delay: 3.5 ms}")

HELD = """\
topology: held
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}
couplers: {wall: {type: SampledSpringDamper, a: device, b: ground, stiffness: 400 N/m, clock: haptic}}
"""


TEXTS = {"average": AVERAGE, "mesh": MESH, "late": LATE}
# The topologies every export has to carry.
EVERY = (*TEXTS, *NAMES)


def made(name: str) -> apc.Model:
    return compiled(TEXTS[name]) if name in TEXTS else shipped(name)


@functools.cache
def shipped(name: str) -> apc.Model:
    return apc.compile(TOPOLOGIES / f"{name}.yaml")


def magnitudes(matrix: Floats) -> Floats:
    """Return the magnitudes of a matrix's eigenvalues, largest first."""
    return np.sort(np.abs(np.linalg.eigvals(matrix)))[::-1]


def cuts(model: apc.Model) -> list[str]:
    """Return all that a topology can be cut at."""
    forces = {hold.name.rpartition(".")[0] for peer_type in model.peer_types for hold in peer_type.holds}
    return [*(link.name for link in model.links), *sorted(forces)]


@pytest.mark.few(4)
@pytest.mark.parametrize("name", EVERY)
def test_cut_open_and_closed_again_it_is_the_loop(name: str) -> None:
    whole = state_space(made(name))
    for cut in cuts(made(name)):
        found = state_space(made(name), open_at=cut)
        assert found.states == whole.states
        repeated = np.linalg.solve(np.eye(len(found.d)) + found.d, found.c)
        # The forces of a stiff contact are thousands of newtons a metre: roundings of the solution.
        scale = np.abs(found.b) @ np.abs(repeated) + np.abs(whole.a)
        assert (np.abs(found.a - found.b @ repeated - whole.a) <= 1e-13 * (1 + scale)).all(), cut


def grows(found: StateSpace, gain: float) -> bool:
    """Say whether a loop cut open and closed with a gain is unstable, its translation left out."""
    closed = found.a - gain * found.b @ np.linalg.solve(np.eye(len(found.d)) + gain * found.d, found.c)
    return bool(magnitudes(closed)[1] > 1)


@pytest.mark.few(1)
@pytest.mark.parametrize("cut", ["contact", "coordination"])
def test_the_gain_margin_of_a_coupler_cut_open_is_that_of_its_stiffness(cut: str) -> None:
    """Its force is its stiffness times a length: all else is as it was."""
    margin = next(one for one in apc.margins(made("average")).rows if one.parameter == f"{cut}.stiffness")
    found = state_space(made("average"), open_at=cut)
    assert margin.gain_margin is not None
    assert not grows(found, margin.gain_margin * (1 - 1e-8))
    assert grows(found, margin.gain_margin * (1 + 1e-8))


@pytest.mark.whole
def test_python_control_finds_the_poles_and_margins_that_apc_finds() -> None:
    """A loop of one peer and one tick a frame has one input and one output, cut at its wall."""
    control = pytest.importorskip("control")
    opened = state_space(made("average"), open_at="lan").to_control()
    assert opened.dt == 0.008
    closed = control.feedback(opened, np.eye(opened.ninputs))
    poles = np.sort(np.abs(closed.poles()))[::-1]
    assert poles[:2] == pytest.approx([1.0, apc.analyze(made("average")).spectral_radius], abs=1e-11)
    model = compiled(HELD)
    gain, _, crossing, _ = control.margin(state_space(model, open_at="wall").to_control())
    margin = next(one for one in apc.margins(model).rows if one.parameter == "wall.stiffness")
    assert gain == pytest.approx(margin.gain_margin, rel=1e-9)
    assert crossing / (2 * np.pi) == pytest.approx(margin.frequency_hz, rel=1e-9)


HAND = "hands:\n  hand: {type: ConstantForce, flange: PART, force: 0 N}\n"
# A topology, whose part is pushed, and what else is set.
PUSHED: dict[str, tuple[str, str, str, dict[str, str]]] = {
    "unlike masses": ("unlike-devices", "trainee", "device", {}),
    "late": ("unlike-devices", "trainee", "device", {"lan.delay": "3.5 ms"}),
    "unlike clocks": ("mixed-clocks", "far", "device", {}),
    "others": (
        "mixed-clocks",
        "far",
        "device",
        {"wan.delay": "13.7 ms", "near.contact.stiffness": "700 N/m"},
    ),
    "one end of a bar": ("two-handed-tool", "user", "left", {}),
}


@pytest.mark.few(3)
@pytest.mark.parametrize("name", PUSHED)
def test_its_step_response_is_what_simulate_plays(name: str) -> None:
    topology, group, part, settings = PUSHED[name]
    text = (TOPOLOGIES / f"{topology}.yaml").read_text(encoding="utf-8") + HAND.replace("PART", part)
    model = apc.set_parameters(compiled(text), settings)
    found = state_space(model)
    run = apc.simulate(model, params={f"{group}.hand.force": "1 N"}, duration="0.3 s", jit=False)
    pushed = [port.name.startswith(f"force on {group}[") and part in port.name for port in found.inputs]
    x, every = np.zeros(len(found.a)), round(found.frame_s / float(run.time[1] - run.time[0]))
    for row in range(0, len(run.time), every):
        for place, port in enumerate(found.outputs):
            rows = run[port.name]
            assert abs(found.c[place] @ x - rows[row]) <= 1e-9 * max(1e-3, np.abs(rows).max()), port.name
        x = found.a @ x + found.b @ pushed
    assert min(np.abs(run[one.name]).max() for one in run.signals if one.local.endswith("x")) > 1e-6


def test_what_a_force_and_noise_move_in_the_end_is_known() -> None:
    """A spring gives way by F/k; one that is told of a place too far by n pulls back by n."""
    found = state_space(compiled(HELD))
    assert [port.name for port in found.inputs] == ["force on user[1].device", "noise on user[1].device.x"]
    steady = found.c @ np.linalg.solve(np.eye(len(found.a)) - found.a, found.b) + found.d
    gains = dict(zip((port.name for port in found.outputs), steady.tolist(), strict=True))
    assert gains["user[1].device.x"] == pytest.approx([1 / 400, -1.0], rel=1e-12)
    assert gains["user[1].wall.f"] == pytest.approx([1.0, 0.0], abs=1e-9)


def matrices(found: StateSpace) -> list[list[list[float]]]:
    return [one.tolist() for one in found.matrices]


def opened(path: Path) -> dict[str, Any]:
    if path.suffix == ".py":
        pytest.importorskip("control")
        return runpy.run_path(str(path))
    if path.suffix == ".mat":
        return dict(pytest.importorskip("scipy.io").loadmat(path, squeeze_me=True))
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)


@pytest.mark.whole
@pytest.mark.parametrize("suffix", [".py", ".mat", ".npz"])
def test_every_file_holds_the_same(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["export", "--out", f"loop{suffix}", "--open-at", "lan", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    found = state_space(compiled(AVERAGE), open_at="lan")
    read = opened(tmp_path / f"loop{suffix}")
    assert [reported[name] for name in "abcd"] == matrices(found)
    assert [np.asarray(read[name]).tolist() for name in "ABCD"] == matrices(found)
    assert float(read["dt"]) == 0.008
    if suffix == ".py":
        assert read["states"] == [(port.name, port.unit) for port in found.states]
        assert read["system"].A.tolist() == read["A"]
    else:
        assert read["states"].tolist() == [port.name for port in found.states]
        assert read["state_units"].tolist() == [port.unit for port in found.states]
        assert json.loads(str(read["provenance"]))["topology"] == "three-users-average"


def test_a_topologies_words_are_never_read_as_python(tmp_path: Path) -> None:
    """Python quotes, ends of lines and braces in what a topology says of itself."""
    found = state_space(compiled(AVERAGE))
    evil = StateSpace(
        'x"""\\\nimport os; os.abort()\n"""{0}', found.open_at, found.frame_s, *found.matrices,
        *(found.states, found.inputs, found.outputs), ('"""\nraise SystemExit',), '"""\nraise SystemExit',
    )  # fmt: skip
    from apc.exports.state_space_files import write_script

    write_script(path := tmp_path / "loop.py", evil)
    pytest.importorskip("control")
    assert runpy.run_path(str(path))["made_by"] == evil.made_by


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "x.foo"], "x.foo: E878 suffix of --out: expected one of .py"),
        (["--out", "x.npz", "--to", "mat"], "x.npz: E878 suffix of --out: expected .mat, got .npz"),
        (["--out", "x.mat", "--to", "matlab"], "--to: E952 format: expected one of control"),
        (
            ["--out", "x.mat", "--open-at", "lann"],
            "--open-at: E950 lann is not a link or sampled coupler of three-users-average",
        ),
        (["--out", "x.npz", "--symbolic", "lan.delay"], "--symbolic: E954 lan.delay is a time"),
        (["--out", "x.npz", "--symbolic", "device.mas"], "--symbolic: E622 device.mas is not a parameter"),
        (
            ["--out", "x.npz", "--symbolic", "device.mass", "--symbolic", "device.mass"],
            "--symbolic: E954 device.mass is",
        ),
        (
            ["--out", "x.py", "--symbolic", "device.mass"],
            "--symbolic: E953 --symbolic has no effect for the format",
        ),
        (["--out", "no/x.mat"], "no/x.mat: E601 can't be written"),
        (["--out", "topology.yaml", "--to", "npz"], "topology.yaml: E878"),
    ],
)
def test_what_cannot_be_is_told_and_nothing_is_written(
    words: list[str], message: str, refused: Callable[..., str]
) -> None:
    assert refused(AVERAGE, *words).startswith(message)


def test_more_peers_than_the_memory_holds_are_refused_before_anything_is_built() -> None:
    many = compiled(replaced(AVERAGE, ("count: 3", "count: 1000000")))
    with pytest.raises(ApcError, match=r"E951 .* of 1,000,000 peers. need about .* of memory"):
        state_space(many)
    masses = ", ".join(f"{0.1 + k * 1e-4} kg" for k in range(400))
    unlike = compiled(replaced(AVERAGE, ("{count: 3}", f"{{set: {{device.mass: [{masses}]}}}}")))
    with pytest.raises(ApcError, match=r"E951 400 different peers .* Reduce the number of peers"):
        state_space(unlike)


FREE = {
    "average": ("coordination.stiffness", "device.mass"),
    "mixed-clocks": ("near.coordination.stiffness",),
    "experiment-average": ("contact.stiffness", "contact.damping"),
    "late": ("coordination.damping",),
    "mesh": ("cube.mass",),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("cut", ["", "link", "coupler"])
@pytest.mark.parametrize("name", FREE)
def test_with_a_number_free_it_is_at_each_value_what_it_is_with_that_set(name: str, cut: str) -> None:
    model = made(name)
    at = {"": "", "link": cuts(model)[0], "coupler": cuts(model)[-1]}[cut]
    found = apc.export(model, "npz", symbolic=FREE[name], open_at=at)
    assert isinstance(found, StateSpace)
    now = {one.name: one.value for one in model.parameters}
    for factor in (1.0, 1.7, 30.0):
        values = [(now[label.removeprefix("near.")] or 1.0) * factor for label in FREE[name]]
        texts = [f"{value!r} {port.unit}" for value, port in zip(values, found.symbolic, strict=True)]
        changed = apc.set_parameters(model, dict(zip(FREE[name], texts, strict=True)))
        there = state_space(changed, open_at=found.open_at)
        for one, other in zip(found.function(*values), there.matrices, strict=True):
            assert np.abs(np.array(one) - other).max() <= 1e-12 * max(1.0, np.abs(other).max())


def test_a_free_named_number_moves_all_that_follows_from_it_and_is_in_the_file(tmp_path: Path) -> None:
    casadi = pytest.importorskip("casadi")
    named = ("peers:", "parameters: {kt: 500 N/m}\npeers:"), ("stiffness: 500 N/m", "stiffness: 2*kt")
    apc.export(compiled(replaced(AVERAGE, *named)), out=tmp_path / "family.npz", symbolic=["kt"])
    with np.load(tmp_path / "family.npz", allow_pickle=False) as archive:
        function = casadi.Function.deserialize(str(archive["casadi_function"]))
        assert archive["symbolic"].tolist() == ["kt"]
    there = state_space(compiled(replaced(AVERAGE, ("stiffness: 500 N/m", "stiffness: 1400 N/m"))))
    assert np.abs(np.array(function(700.0)[0]) - there.a).max() < 1e-12 * np.abs(there.a).max()
