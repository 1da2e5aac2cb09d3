"""`exports`: a scene handed over, opened again by the tools it is handed to."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.exports.lifted import StateSpace, state_space
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

Floats = NDArray[np.float64]

# Groups of unlike clocks and delays, contacts, damping, a server, packets heard in the frame they are sent in.
NAMES = ("mixed-clocks", "experiment-average", "client-server", "star-lecture", "two-users-waves", "finger")
LATE = AVERAGE.replace("lan: {clock: network, delay: 8 ms}", "lan: {clock: network, delay: 3.5 ms}")
PUSHED = AVERAGE + "hands:\n  hand: {type: ConstantForce, flange: device, force: 0 N}\n"


def scenes() -> dict[str, apc.CompiledSystem]:
    """Return the scenes every export has to carry."""
    texts = {"average": AVERAGE, "mesh": MESH, "late": LATE}
    return {name: compiled(text) for name, text in texts.items()} | {
        name: apc.compile(SCENES / f"{name}.yaml") for name in NAMES
    }


ALL = scenes()


def magnitudes(matrix: Floats) -> Floats:
    """Return the magnitudes of a matrix's eigenvalues, largest first."""
    return np.sort(np.abs(np.linalg.eigvals(matrix)))[::-1]


@pytest.mark.parametrize("name", ALL)
def test_its_eigenvalues_are_those_of_the_analysis(name: str) -> None:
    analysis = apc.analyze(ALL[name])
    modes = [mode.magnitude for mode in analysis.modes for _ in range(mode.multiplicity)]
    wanted = np.sort([*modes, *[1.0] * analysis.rigid_modes])[::-1]
    found = magnitudes(state_space(ALL[name]).a)
    large = wanted[wanted > 1e-2]  # defective ones near 0 are known to no digit
    assert found[: len(large)] == pytest.approx(large, abs=1e-7)  # a pair may be a double root
    assert (found[len(large) :] < 1.5e-2).all()


def cuts(system: apc.CompiledSystem) -> list[str]:
    """Return all that a scene can be cut at."""
    forces = {hold.name.rpartition(".")[0] for kind in system.kinds for hold in kind.holds}
    return [*(link.name for link in system.links), *sorted(forces)]


@pytest.mark.parametrize("name", ALL)
def test_cut_open_and_closed_again_it_is_the_loop(name: str) -> None:
    whole = state_space(ALL[name])
    for cut in cuts(ALL[name]):
        found = state_space(ALL[name], cut=cut)
        assert found.states == whole.states
        again = np.linalg.solve(np.eye(len(found.d)) + found.d, found.c)
        # The forces of a stiff contact are thousands of newtons a metre: roundings of the solution.
        scale = np.abs(found.b) @ np.abs(again) + np.abs(whole.a)
        assert (np.abs(found.a - found.b @ again - whole.a) <= 1e-13 * (1 + scale)).all(), cut


@pytest.mark.parametrize("cut", ["", "lan", "coordination"])
def test_python_control_finds_the_same_poles(cut: str) -> None:
    control = pytest.importorskip("control")
    found = state_space(ALL["average"], cut=cut)
    system = found.to_control()
    assert system.dt == found.frame_s == 0.008
    assert (system.ninputs, system.noutputs, system.nstates) == (*found.d.shape[::-1], len(found.a))
    if cut:
        system = control.feedback(system, np.eye(len(found.d)))
    poles = np.sort(np.abs(system.poles()))[::-1]
    assert poles[:2] == pytest.approx([1.0, apc.analyze(ALL["average"]).spectral_radius], abs=1e-11)


def grows(found: StateSpace, gain: float) -> bool:
    """Say whether a loop cut open and closed with a gain is unstable, its translation left out."""
    closed = found.a - gain * found.b @ np.linalg.solve(np.eye(len(found.d)) + gain * found.d, found.c)
    return bool(magnitudes(closed)[1] > 1)


@pytest.mark.parametrize("cut", ["contact", "coordination"])
def test_the_gain_margin_of_a_coupler_cut_open_is_that_of_its_stiffness(cut: str) -> None:
    """Its force is its stiffness times a length: all else is as it was."""
    margin = next(one for one in apc.margins(ALL["average"]).rows if one.parameter == f"{cut}.stiffness")
    found = state_space(ALL["average"], cut=cut)
    assert margin.factor is not None
    assert not grows(found, margin.factor * (1 - 1e-8))
    assert grows(found, margin.factor * (1 + 1e-8))


def pushed(text: str, peer: int, group: str = "user") -> tuple[apc.CompiledSystem, apc.CompiledSystem]:
    """Return a scene at rest, and the same with 1 N at a peer's device."""
    count = compiled(text).peers
    push = ", ".join("1 N" if one == peer else "0 N" for one in range(count))
    own = f"{group}: {{count: {count}}}"
    moved = replaced(text, own, f"{group}: {{count: {count}, set: {{hand.force: [{push}]}}}}")
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
