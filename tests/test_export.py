"""`exports`: a scene handed over, opened again by the tools it is handed to."""

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
from apc.analysis.analysis import lifted_groups
from apc.compiler.errors import ApcError
from apc.exports.lifted import StateSpace, state_space
from apc.frame import devices
from apc.frame.devices import Push, find_push
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

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
PUSHED = AVERAGE + "hands:\n  hand: {type: ConstantForce, flange: device, force: 0 N}\n"

HELD = """\
topology: held
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}
couplers: {wall: {type: SampledSpringDamper, a: device, b: ground, stiffness: 400 N/m, clock: haptic}}
"""


TEXTS = {"average": AVERAGE, "mesh": MESH, "late": LATE}
# The scenes every export has to carry.
EVERY = (*TEXTS, *NAMES)


def made(name: str) -> apc.CompiledSystem:
    return compiled(TEXTS[name]) if name in TEXTS else shipped(name)


@functools.cache
def shipped(name: str) -> apc.CompiledSystem:
    return apc.compile(SCENES / f"{name}.yaml")


def magnitudes(matrix: Floats) -> Floats:
    """Return the magnitudes of a matrix's eigenvalues, largest first."""
    return np.sort(np.abs(np.linalg.eigvals(matrix)))[::-1]


@pytest.mark.parametrize("name", EVERY)
def test_its_eigenvalues_are_those_of_the_analysis(name: str) -> None:
    analysis = apc.analyze(made(name))
    modes = [mode.magnitude for mode in analysis.modes for _ in range(mode.multiplicity)]
    wanted = np.sort([*modes, *[1.0] * analysis.rigid_modes])[::-1]
    found = magnitudes(state_space(made(name)).a)
    large = wanted[wanted > 1e-2]  # defective ones near 0 are known to no digit
    assert found[: len(large)] == pytest.approx(large, abs=1e-7)  # a pair may be a double root
    assert (found[len(large) :] < 1.5e-2).all()


def cuts(system: apc.CompiledSystem) -> list[str]:
    """Return all that a scene can be cut at."""
    forces = {hold.name.rpartition(".")[0] for kind in system.kinds for hold in kind.holds}
    return [*(link.name for link in system.links), *sorted(forces)]


@pytest.mark.parametrize("name", EVERY)
def test_cut_open_and_closed_again_it_is_the_loop(name: str) -> None:
    whole = state_space(made(name))
    for cut in cuts(made(name)):
        found = state_space(made(name), cut=cut)
        assert found.states == whole.states
        again = np.linalg.solve(np.eye(len(found.d)) + found.d, found.c)
        # The forces of a stiff contact are thousands of newtons a metre: roundings of the solution.
        scale = np.abs(found.b) @ np.abs(again) + np.abs(whole.a)
        assert (np.abs(found.a - found.b @ again - whole.a) <= 1e-13 * (1 + scale)).all(), cut


@pytest.mark.parametrize("cut", ["", "lan", "coordination"])
def test_python_control_finds_the_same_poles(cut: str) -> None:
    control = pytest.importorskip("control")
    found = state_space(made("average"), cut=cut)
    system = found.to_control()
    assert system.dt == found.frame_s == 0.008
    assert (system.ninputs, system.noutputs, system.nstates) == (*found.d.shape[::-1], len(found.a))
    if cut:
        system = control.feedback(system, np.eye(len(found.d)))
    poles = np.sort(np.abs(system.poles()))[::-1]
    assert poles[:2] == pytest.approx([1.0, apc.analyze(made("average")).spectral_radius], abs=1e-11)


def grows(found: StateSpace, gain: float) -> bool:
    """Say whether a loop cut open and closed with a gain is unstable, its translation left out."""
    closed = found.a - gain * found.b @ np.linalg.solve(np.eye(len(found.d)) + gain * found.d, found.c)
    return bool(magnitudes(closed)[1] > 1)


@pytest.mark.parametrize("cut", ["contact", "coordination"])
def test_the_gain_margin_of_a_coupler_cut_open_is_that_of_its_stiffness(cut: str) -> None:
    """Its force is its stiffness times a length: all else is as it was."""
    margin = next(one for one in apc.margins(made("average")).rows if one.parameter == f"{cut}.stiffness")
    found = state_space(made("average"), cut=cut)
    assert margin.factor is not None
    assert not grows(found, margin.factor * (1 - 1e-8))
    assert grows(found, margin.factor * (1 + 1e-8))


def test_python_control_finds_the_margins_that_apc_finds() -> None:
    """A loop of one peer and one tick a frame has one input and one output, cut at its wall."""
    control = pytest.importorskip("control")
    system = compiled(HELD)
    gain, _, crossing, _ = control.margin(state_space(system, cut="wall").to_control())
    margin = next(one for one in apc.margins(system).rows if one.parameter == "wall.stiffness")
    assert gain == pytest.approx(margin.factor, rel=1e-9)
    assert crossing / (2 * np.pi) == pytest.approx(margin.frequency_hz, rel=1e-9)


def test_of_each_part_it_is_found_once_what_a_force_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of many positions is looked through whole: once for each of them took minutes."""
    asked: list[str] = []
    known = devices.find_device

    def counted(*told: Any, part: str) -> Any:
        asked.append(part)
        return known(*told, part=part)

    monkeypatch.setattr(devices, "find_device", counted)
    state_space(shipped("planar-users"))
    assert asked
    assert len(asked) == len(set(asked))


def test_a_force_on_what_a_bar_joins_moves_both_its_ends() -> None:
    """Of a tool m_t midway between m and m: M = [[m + m_t/4, m_t/4], [m_t/4, m + m_t/4]]."""
    system = apc.compile(SCENES / "two-handed-tool.yaml")
    (group,), _ = lifted_groups(system)
    units = {one.name: one.unit for one in system.parameters}
    found = [find_push(group.jacobians, group.parameters, units, None, place) for place in (0, 2)]
    wanted = np.linalg.inv([[0.15, 0.05], [0.05, 0.15]])
    for column, push in zip(wanted.T, found, strict=True):
        assert isinstance(push, Push)
        assert push.velocities == (1, 3)
        assert [*map(float, push.inverses)] == pytest.approx(column, rel=1e-14)


def pushed(text: str, peer: int, group: str = "user") -> tuple[apc.CompiledSystem, apc.CompiledSystem]:
    """Return a scene at rest, and the same with 1 N at a peer's device."""
    count = compiled(text).peers
    push = ", ".join("1 N" if one == peer else "0 N" for one in range(count))
    own = f"{group}: {{count: {count}}}"
    moved = replaced(text, (own, f"{group}: {{count: {count}, set: {{hand.force: [{push}]}}}}"))
    return compiled(text), compiled(moved)


@pytest.mark.parametrize(
    "text", [PUSHED, PUSHED.replace("delay: 8 ms}", "delay: 3.5 ms}")], ids=["8 ms", "3.5 ms"]
)
def test_its_step_response_is_what_simulate_plays(text: str) -> None:
    control = pytest.importorskip("control")
    system, moved = pushed(text, 1)
    found = state_space(system)
    frames = 60
    inputs = np.zeros((len(found.inputs), frames + 1))
    inputs[[port.name for port in found.inputs].index("force on user[2].device")] = 1.0
    response = control.forced_response(found.to_control(), inputs=inputs)
    played = apc.simulate(moved, duration=f"{8 * frames} ms", jit=False)
    for place, port in enumerate(found.outputs):
        rows = played[port.name][::8]
        assert np.abs(response.outputs[place] - rows[: frames + 1]).max() <= 1e-9 * max(
            1.0, np.abs(rows).max()
        )
        assert np.abs(rows).max() > 1e-6  # something is compared


def test_what_a_force_and_noise_move_in_the_end_is_known() -> None:
    """A spring gives way by F/k; one that is told of a place too far by n pulls back by n."""
    found = state_space(compiled(HELD))
    assert [port.name for port in found.inputs] == ["force on user[1].device", "noise on user[1].device.x"]
    steady = found.c @ np.linalg.solve(np.eye(len(found.a)) - found.a, found.b) + found.d
    gains = dict(zip((port.name for port in found.outputs), steady.tolist(), strict=True))
    assert gains["user[1].device.x"] == pytest.approx([1 / 400, -1.0], rel=1e-12)
    assert gains["user[1].wall.f"] == pytest.approx([1.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("settings", [{}, {"wan.delay": "13.7 ms", "near.contact.stiffness": "700 N/m"}])
def test_groups_of_unlike_clocks_answer_a_step_as_simulate_plays_it(settings: dict[str, str]) -> None:
    text = (SCENES / "mixed-clocks.yaml").read_text(encoding="utf-8")
    held = compiled(text + "hands:\n  hand: {type: ConstantForce, flange: device, force: 0 N}\n")
    system = apc.set_parameters(held, settings)
    found = state_space(system)
    played = apc.simulate(system, set={"far.hand.force": "1 N"}, duration="0.4 s", jit=False)
    at = {port.name: place for place, port in enumerate(found.inputs)}
    x, push = np.zeros(len(found.a)), found.b[:, at["force on far[1].device"]]
    every = round(found.frame_s / float(played.time[1] - played.time[0]))
    for row in range(0, len(played.time), every):
        for place, port in enumerate(found.outputs):
            size = max(1e-3, np.abs(played[port.name]).max())
            assert abs(found.c[place] @ x - played[port.name][row]) <= 1e-9 * size, port.name
        x = found.a @ x + push
    assert np.abs(played["near[1].cube.x"]).max() > 1e-5  # it came through


def matrices(found: StateSpace) -> list[list[list[float]]]:
    return [one.tolist() for one in found.matrices]


@pytest.mark.parametrize("suffix", [".py", ".mat", ".npz"])
def test_every_file_holds_the_same(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    path = tmp_path / f"loop{suffix}"
    assert run(["export", "--out", path.name, "--cut", "lan", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = state_space(compiled(AVERAGE), cut="lan")
    assert [told[name] for name in "abcd"] == matrices(found)
    names = [port.name for port in found.states]
    read: dict[str, Any]
    if suffix == ".py":
        pytest.importorskip("control")
        read = runpy.run_path(str(path))
        assert read["states"] == [(port.name, port.unit) for port in found.states]
        assert read["system"].state_labels == found.to_control().state_labels
        assert read["system"].A.tolist() == read["A"]
        assert [read[name] for name in "ABCD"] == matrices(found)
    elif suffix == ".mat":
        read = pytest.importorskip("scipy.io").loadmat(path, squeeze_me=True)
        assert read["states"].tolist() == names
        assert read["state_units"].tolist() == [port.unit for port in found.states]
        assert [read[name].tolist() for name in "ABCD"] == matrices(found)
        assert json.loads(str(read["provenance"]))["topology"] == "three-users-average"
    else:
        with np.load(path, allow_pickle=False) as archive:
            read = dict(archive)
        assert read["states"].tolist() == names
        assert [read[name].tolist() for name in "ABCD"] == matrices(found)
    assert float(read["dt"]) == 0.008


def test_a_scenes_words_are_never_read_as_python(tmp_path: Path) -> None:
    """Python quotes, ends of lines and braces in what a scene says of itself."""
    found = state_space(compiled(AVERAGE))
    evil = StateSpace(
        'x"""\\\nimport os; os.abort()\n"""{0}', found.cut, found.frame_s, *found.matrices,
        *(found.states, found.inputs, found.outputs), ('"""\nraise SystemExit',), '"""\nraise SystemExit',
    )  # fmt: skip
    from apc.exports.files import write_script

    write_script(path := tmp_path / "loop.py", evil)
    pytest.importorskip("control")
    assert runpy.run_path(str(path))["made_by"] == evil.made_by


def test_words_for_names_are_never_alike() -> None:
    from apc.exports.words import Port, words

    assert words([Port("a.b", ""), Port("a_b", ""), Port("a_b_2", ""), Port("a[b]", "")]) == [
        "a_b", "a_b_2", "a_b_2_2", "a_b_3",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "x.foo"], "x.foo: E878 the suffix of --out wants one of .py"),
        (["--out", "x.npz", "--to", "mat"], "x.npz: E878 the suffix of --out wants .mat, got .npz"),
        (["--out", "x.mat", "--to", "matlab"], "--to: E952 a format wants one of control"),
        (
            ["--out", "x.mat", "--cut", "lann"],
            "--cut: E950 lann is no link or coupler with ticks of three-users-average",
        ),
        (["--out", "x.npz", "--free", "lan.delay"], "--free: E954 lan.delay is a time"),
        (["--out", "x.npz", "--free", "device.mas"], "--free: E622 device.mas is no parameter"),
        (["--out", "x.npz", "--free", "device.mass", "--free", "device.mass"], "--free: E954 device.mass is"),
        (
            ["--out", "x.py", "--free", "device.mass"],
            "--free: E953 --free means nothing to the format",
        ),
        (["--out", "no/x.mat"], "no/x.mat: E601 can't be written"),
        (["--out", "scene.yaml", "--to", "npz"], "scene.yaml: E878"),
    ],
)
def test_what_cannot_be_is_told_and_nothing_is_written(
    words: list[str], message: str, refused: Callable[..., str]
) -> None:
    assert refused(AVERAGE, *words).startswith(message)


def test_more_peers_than_the_memory_holds_are_refused_before_anything_is_built() -> None:
    many = compiled(replaced(AVERAGE, ("count: 3", "count: 1000000")))
    with pytest.raises(ApcError, match=r"E951 .* all 1,000,000 peers .* take about .* of memory"):
        state_space(many)


def test_different_peers_that_are_too_many_are_refused_too() -> None:
    masses = ", ".join(f"{0.1 + k * 1e-4} kg" for k in range(400))
    many = compiled(replaced(AVERAGE, ("{count: 3}", f"{{set: {{device.mass: [{masses}]}}}}")))
    with pytest.raises(ApcError, match=r"E951 400 different peers .* Write: fewer peers"):
        state_space(many)


def test_from_python_the_suffix_says_the_format(tmp_path: Path) -> None:
    found = apc.export(SCENES / "three-users-average.yaml", out=tmp_path / "loop.npz")
    assert isinstance(found, StateSpace)
    assert matrices(found) == matrices(state_space(compiled(AVERAGE)))
    with pytest.raises(ApcError, match="E952"):
        apc.export(made("average"))


FREE = {
    "average": ("coordination.stiffness", "device.mass"),
    "mixed-clocks": ("near.coordination.stiffness",),
    "experiment-average": ("contact.stiffness", "contact.damping"),
    "client-server": ("device.damping", "contact.stiffness"),
    "late": ("coordination.damping",),
    "mesh": ("cube.mass",),
}


@pytest.mark.few(8)
@pytest.mark.parametrize("cut", ["", "link", "coupler"])
@pytest.mark.parametrize("name", FREE)
def test_with_a_number_free_it_is_at_each_value_what_it_is_with_that_set(name: str, cut: str) -> None:
    system = made(name)
    at = {"": "", "link": cuts(system)[0], "coupler": cuts(system)[-1]}[cut]
    found = apc.export(system, "npz", free=FREE[name], cut=at)
    assert isinstance(found, StateSpace)
    now = {one.name: one.value for one in system.parameters}
    for factor in (1.0, 1.7, 30.0):
        values = [(now[label.removeprefix("near.")] or 1.0) * factor for label in FREE[name]]
        texts = [f"{value!r} {port.unit}" for value, port in zip(values, found.free, strict=True)]
        changed = apc.set_parameters(system, dict(zip(FREE[name], texts, strict=True)))
        there = state_space(changed, cut=found.cut)
        for one, other in zip(found.function(*values), there.matrices, strict=True):
            assert np.abs(np.array(one) - other).max() <= 1e-12 * max(1.0, np.abs(other).max())


def test_a_free_named_number_moves_all_that_follows_from_it() -> None:
    named = ("peers:", "parameters: {kt: 500 N/m}\npeers:"), ("stiffness: 500 N/m", "stiffness: 2*kt")
    found = apc.export(compiled(replaced(AVERAGE, *named)), "npz", free=["kt"])
    assert isinstance(found, StateSpace)
    there = state_space(compiled(replaced(AVERAGE, ("stiffness: 500 N/m", "stiffness: 1400 N/m"))))
    assert np.abs(np.array(found.function(700.0)[0]) - there.a).max() < 1e-12 * np.abs(there.a).max()


def test_the_function_is_in_the_file(tmp_path: Path) -> None:
    casadi = pytest.importorskip("casadi")
    path = tmp_path / "family.npz"
    apc.export(made("average"), out=path, free=["coordination.stiffness"])
    with np.load(path, allow_pickle=False) as archive:
        function = casadi.Function.deserialize(str(archive["casadi_function"]))
        assert archive["free"].tolist() == ["coordination.stiffness"]
    there = state_space(apc.set_parameters(made("average"), {"coordination.stiffness": "800 N/m"}))
    assert np.abs(np.array(function(800.0)[0]) - there.a).max() < 1e-12 * np.abs(there.a).max()
