"""FMUs: another program opens them, finds nothing wrong, and plays what `simulate` plays."""

from __future__ import annotations

import ctypes
import subprocess
import xml.etree.ElementTree as xml
import zipfile
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.exports.code import topology_unit
from apc.exports.fmu import FmuContent, write_fmu
from tests.hand_over.in_c import STRICT, compiler
from tests.hand_over.test_c import BENT, INSIDE, LOSSY, LOSSY_HOLD, MIXED, MOVED, PAIRS, PAPER
from tests.topologies import AVERAGE, compiled, replaced

AT_ONCE = replaced(MOVED, ("{clock: network, delay: 8 ms}", "{clock: network, delay: 0 s}"))
OWN = replaced(
    MOVED, ("user: {count: 3", "user: {count: 3, set: {device.mass: [0.1 kg, 0.2 kg, 0.15 kg]}"),
    (", set: {device.x: [30 mm, -20 mm, 7 mm]}", ""),
    ("damping: 5 N*s/m}", "damping: 5 N*s/m, x: 3 mm}"),
)  # fmt: skip
BURSTS = replaced(
    MOVED, ("delay: 8 ms}", "delay: 8 ms, jitter: 4 ms, distribution: pareto, loss: {p: 10 %, r: 30 %}}")
)
ROOMS = replaced(
    MIXED,
    (
        "delays: {near: {far: 40 ms}, far: {near: 40 ms}}",
        "loss: 5 %, pairs: {near: {far: {delay: 40 ms, loss: {p: 20 %, r: 30 %}, jitter: 3 ms, "
        "distribution: normal}}, far: {near: {delay: 30 ms, on_loss: zero, loss: 30 %}}}",
    ),
)
TOPOLOGIES = {
    "moved": MOVED,
    "mixed clocks": MIXED,
    "a delay inside a tick": INSIDE,
    "pairs": PAIRS,
    "pairs of groups": ROOMS,
    "late and lost, hold": LOSSY_HOLD,
    "bursts": BURSTS,
    "paper": PAPER,
    "heard as it is sent": AT_ONCE,
    "own masses": OWN,
    "late and lost, zero": LOSSY,
}


@pytest.fixture
def fmpy() -> Any:
    """Return FMPy, which the extra `test` installs."""
    compiler()
    pytest.importorskip("fmpy", reason="FMPy is not installed")
    return pytest.importorskip("fmpy.validation", reason="FMPy is not installed")


def written(text: str, folder: Path, *, peer: str = "", method: str = "") -> tuple[Path, FmuContent]:
    unit = topology_unit(compiled(text), peer=peer, method=method)
    write_fmu(path := folder / f"{unit.topology.name}.fmu", unit)
    return path, unit


def gap(model: apc.Model, path: Path, unit: FmuContent, method: str = "", seconds: float = 0.5) -> float:
    """Return how far what FMPy plays is from what `simulate` plays, of the largest value."""
    import fmpy as player

    course = apc.simulate(model, duration=f"{seconds} s", method=method or None, jit=False)
    found = player.simulate_fmu(path, stop_time=seconds, output_interval=unit.step)
    rows = np.array([found[one.name] for one in course.signals]).T
    assert rows.shape == course.values.shape
    assert np.abs(course.values).max() > 1e-3
    return float(np.abs(rows - course.values).max() / max(1.0, np.abs(course.values).max()))


@pytest.mark.few(1)
@pytest.mark.parametrize("name", TOPOLOGIES)
def test_a_topology_is_played_as_simulate_plays_it(name: str, fmpy: Any, tmp_path: Path) -> None:
    path, unit = written(TOPOLOGIES[name], tmp_path)
    assert not fmpy.validate_fmu(path)
    assert gap(compiled(TOPOLOGIES[name]), path, unit) < 1e-9


@pytest.mark.whole
def test_recorded_delays_are_played_one_after_another(fmpy: Any, tmp_path: Path) -> None:
    (tmp_path / "delays.csv").write_text("delay [ms]\n8\n9.5\n\n21\n7\n8\n30\n", encoding="utf-8")
    text = replaced(MOVED, ("delay: 8 ms}", "trace: delays.csv}"))
    (tmp_path / "topology.yaml").write_text(text, encoding="utf-8")
    model = apc.compile(tmp_path / "topology.yaml")
    write_fmu(path := tmp_path / "topology.fmu", unit := topology_unit(model))
    assert gap(model, path, unit) < 1e-9


@pytest.mark.whole
def test_what_is_not_linear_is_played_by_the_steps_asked_for(fmpy: Any, tmp_path: Path) -> None:
    path, unit = written(BENT, tmp_path, method="rk4:0.5ms")
    assert not fmpy.validate_fmu(path)
    assert gap(compiled(BENT), path, unit, "rk4:0.5ms", 0.1) < 1e-9


class Instance:
    """An FMU that is stepped by hand."""

    def __init__(self, path: Path, folder: Path) -> None:
        from fmpy import extract, read_model_description
        from fmpy.fmi2 import FMU2Slave

        reported = read_model_description(str(path))
        self.references = {one.name: one.valueReference for one in reported.modelVariables}
        self.inputs = [one.name for one in reported.modelVariables if one.causality == "input"]
        self.unit = FMU2Slave(
            guid=reported.guid,
            unzipDirectory=extract(str(path), str(folder)),
            modelIdentifier=reported.coSimulation.modelIdentifier,
            instanceName="one",
        )
        self.unit.instantiate()
        self.begin({})

    def begin(self, starts: dict[str, float]) -> None:
        self.unit.setupExperiment(startTime=0.0)
        self.set(**starts)
        self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()

    def read(self, *names: str) -> list[float]:
        return list(self.unit.getReal([self.references[one] for one in names]))

    def set(self, **values: float) -> None:
        for name, value in values.items():
            (self.unit.setBoolean if name.endswith("missing") else self.unit.setReal)(
                [self.references[name]], [value]
            )

    def step(self, at: float, by: float) -> None:
        self.unit.doStep(currentCommunicationPoint=at, communicationStepSize=by)

    def end(self) -> None:
        self.unit.terminate()
        self.unit.freeInstance()


@pytest.mark.whole
@pytest.mark.parametrize(("text", "late"), [(PAPER, 8), (AT_ONCE, 0), (MOVED, 8)])
def test_peers_joined_by_a_network_of_ones_own_are_the_topology(
    text: str, late: int, fmpy: Any, tmp_path: Path
) -> None:
    """Each is told at every millisecond what the others' outputs were so long ago."""
    model = compiled(text)
    course = apc.simulate(model, duration="0.2 s", jit=False)
    names = [f"{group.name}[{k + 1}]" for group in model.groups for k in range(group.count)]
    running = {}
    for name in names:
        path, unit = written(text, tmp_path, peer=name)
        assert not fmpy.validate_fmu(path)
        running[name] = Instance(path, tmp_path / unit.topology.name)
    known = running[names[0]].references
    channels = [one for one in ("coordination.x", "coordination.v") if f"lan.{one}" in known]
    sent: list[dict[str, list[float]]] = []
    column = {one.name: k for k, one in enumerate(course.signals)}
    off = 0.0
    for k in range(len(course.time)):
        sent.append({name: one.read(*(f"lan.{c}" for c in channels)) for name, one in running.items()})
        for name, one in running.items():
            for signal in ("cube.x", "cube.v", "device.x", "coordination.f"):
                (mine,) = one.read(signal)
                off = max(off, abs(mine - course.values[k, column[f"{name}.{signal}"]]))
            if k >= late:
                one.set(**{
                    f"lan.{other}.{c}": value
                    for other in names if other != name
                    for c, value in zip(channels, sent[k - late][other], strict=True)
                })  # fmt: skip
        for one in running.values():
            one.step(k / 1000, 1 / 1000)
    for one in running.values():
        one.end()
    assert off < 1e-9


@pytest.mark.whole
def test_a_device_that_is_pushed_moves_as_by_a_hand(fmpy: Any, tmp_path: Path) -> None:
    path, _ = written(AVERAGE, tmp_path)
    push = "hands: {push: {type: StepForce, flange: device, force: 2 N, start: 0.01 s}}\nlinks:"
    course = apc.simulate(compiled(replaced(AVERAGE, ("links:", push))), duration="0.1 s", jit=False)
    one = Instance(path, tmp_path / "unzipped")
    assert one.inputs == [f"force on user[{k}].device" for k in (1, 2, 3)]
    names = [name for name in (signal.name for signal in course.signals) if name in one.references]
    places = [place for place, signal in enumerate(course.signals) if signal.name in names]
    assert len(names) > 12
    for k in range(100):
        assert one.read(*names) == pytest.approx(course.values[k, places].tolist(), abs=1e-9)
        one.set(**dict.fromkeys(one.inputs, 2.0 * (k >= 10)))
        one.step(k / 1000, 1 / 1000)
    one.end()


@pytest.mark.whole
def test_a_topology_begins_where_its_states_and_parameters_are_set(fmpy: Any, tmp_path: Path) -> None:
    path, _ = written(PAPER, tmp_path)
    starts = {f"{one}.device.x": 0.0125 for one in ("left[1]", "left[2]", "right[1]")}
    numbers = {"device.x": 0.0125, "contact.stiffness": 800.0}
    course = apc.simulate(compiled(PAPER), params=numbers, duration="0.1 s", jit=False)
    one = Instance(path, tmp_path / "unzipped")
    one.unit.reset()
    softer = {f"{one.removesuffix('device.x')}contact.stiffness": 800.0 for one in starts}
    one.begin(starts | softer)
    names = [one.name for one in course.signals]
    for k in range(100):
        assert one.read(*names) == pytest.approx(course.values[k].tolist(), abs=1e-9)
        one.step(k / 1000, 1 / 1000)
    with pytest.raises(Exception, match="fmi2SetReal"):
        one.set(**softer)  # too late
    one.end()


@pytest.mark.whole
def test_a_step_may_be_of_any_length_and_a_state_can_be_had_back(fmpy: Any, tmp_path: Path) -> None:
    path, _ = written(PAPER, tmp_path)
    course = apc.simulate(compiled(PAPER), duration="0.2 s", jit=False)
    names = [one.name for one in course.signals]
    one = Instance(path, tmp_path / "unzipped")
    steps = [Fraction(by, 100_000) for by in (37, 63, 200, 233)] * 2

    def walk(at: Fraction) -> Fraction:
        for by in [*steps, *steps, Fraction(1, 1000)]:
            length = by if by in steps else by - at % by  # to the next tick in the end
            one.step(float(at), float(length))
            at += length
            if at % Fraction(1, 1000) == 0:
                expected = course.values[int(at * 1000)].tolist()
                assert one.read(*names) == pytest.approx(expected, abs=1e-9)
        return at

    begun = walk(Fraction(0))
    stored, before = one.unit.serializeFMUState(one.unit.getFMUState()), one.read(*names)
    walk(begun)
    end = one.read(*names)
    one.unit.setFMUState(one.unit.deSerializeFMUstate(stored))
    assert one.read(*names) == before
    walk(begun)
    assert one.read(*names) == end
    one.unit.reset()
    one.begin({})
    assert one.read(*names) == course.values[0].tolist()
    one.end()


def test_a_peer_says_what_it_hears_and_sends(tmp_path: Path) -> None:
    compiler()
    path, _ = written(LOSSY, tmp_path, peer="user[2]")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
        reported = xml.fromstring(archive.read("modelDescription.xml"))
        names = archive.namelist()
    causes = {one.get("name"): one.get("causality") for one in reported.iter("ScalarVariable")}
    received = {name for name, cause in causes.items() if cause == "input"}
    reported_by = ("coordination.x", "coordination.v", "missing")
    assert received == {f"lan.user[{k}].{what}" for k in (1, 3) for what in reported_by} | {"force on device"}
    assert causes["lan.coordination.x"] == "output"
    assert next(one for one in names if one.startswith("binaries/")).split("/")[1].endswith("64")
    assert all(f"sources/{one.get('name')}" in names for one in reported.iter("File"))


def test_its_sources_compile_strictly(tmp_path: Path) -> None:
    unit = topology_unit(compiled(LOSSY))
    for name, text in unit.texts.items():
        (tmp_path / name).write_text(text, encoding="ascii")
    sources = [name for name in unit.texts if name.endswith(".c")]
    command = [compiler(), *STRICT, "-O1", "-fPIC", "-shared", *sources, "-o", "all.so"]
    subprocess.run(command, cwd=tmp_path, check=True)


@pytest.mark.whole
def test_another_program_is_not_given_another_topology(fmpy: Any, tmp_path: Path) -> None:
    """A library whose description was exchanged refuses to begin."""
    path, _ = written(PAPER, tmp_path)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
        (name,) = (one for one in archive.namelist() if one.startswith("binaries/"))
    library = ctypes.CDLL(str(tmp_path / name))
    library.fmi2Instantiate.restype = ctypes.c_void_p
    assert library.fmi2Instantiate(b"one", 1, b"another", b"", None, 0, 0) is None
    assert library.fmi2Instantiate(b"one", 0, b"another", b"", None, 0, 0) is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["topology.fmu"], "E960 user[1]: cube.x, cube.v are integrated by CVODES between ticks"),
        (["peer.c"], 'E963 the peers differ; C code is written for one peer. Try: --peer "user[1]"'),
        (
            ["peer.c", "--peer", "user[4]"],
            'E970 peer: expected one of user[1], user[2], user[3], got user[4]. Try: --peer "user[1]"',
        ),
        (
            ["topology.fmu", "--peer", "usr[1]"],
            'E970 peer: expected one of user[1], user[2], user[3], got usr[1]. Try: --peer "user[1]"',
        ),
        (
            ["topology.fmu", "--device", "device"],
            "E953 --device has no effect for the format fmu. Try: --to c",
        ),
    ],
)
def test_what_cannot_be_is_told_and_nothing_is_written(
    words: list[str], message: str, refused: Callable[..., str]
) -> None:
    assert message in refused(BENT, "--out", *words)


def test_more_ways_than_fit_a_text_are_refused() -> None:
    with pytest.raises(
        ApcError, match="E960 200 peers have 39,800 directed connections; the limit of the C export is 20,000"
    ):
        topology_unit(compiled(replaced(AVERAGE, ("count: 3", "count: 200"))))


def test_where_all_peers_are_alike_one_serves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["export", "--out", "peer.c"]) == 0
    assert sorted(one.name for one in tmp_path.iterdir()) == [
        "peer.c",
        "peer.h",
        "peer_test.c",
        "topology.yaml",
    ]


def test_without_a_compiler_there_is_a_message_and_no_archive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("apc.exports.fmu.compiler", lambda: None)
    with pytest.raises(ApcError, match=r"E962 no C compiler found"):
        written(PAPER, tmp_path)
    monkeypatch.setattr("apc.exports.fmu.compiler", lambda: ("/bin/false", ""))
    with pytest.raises(ApcError, match=r"E962 /bin/false failed to compile the code"):
        written(PAPER, tmp_path)
    assert not list(tmp_path.iterdir())
