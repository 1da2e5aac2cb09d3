"""Topologies whose coefficients change with time are refused by name; forces that do move no eigenvalue."""

from __future__ import annotations

from pathlib import Path

import pytest

from apc import analyze, critical
from apc.compiler.errors import ApcError
from tests.topologies import compiled, library

TOPOLOGY = """\
topology: timed
clocks: {haptic: 1 ms}
peers: {user: {count: 2}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 mm}}
couplers: {w: {type: Timed, object: device, clock: haptic, link: lan}}
links: {lan: {clock: haptic, delay: 2 ms}}
"""


PART = """\
component: Timed
description: A spring of one's own making.
connectors: {{object: Flange}}
sends: {{x: sample(object.x), v: sample(der(object.x)), t: time}}
parameters:
  k: {{unit: N/m, default: 100}}
  T: {{unit: s, default: 1}}
  L: {{unit: m, default: 1}}
  clock: clock
  link: link
variables: {{f: {{unit: N, start: 0 N}}, y: {{unit: m, start: 0 m}}}}
equations:
  - y = {y}
  - f = {f}
  - object.f = {flow}
"""


PLAIN = {"y": "sample(object.x)", "f": "k*y", "flow": "hold(f)"}


# What multiplies something that moves, in every place where something can: each is of another frame than the
# one that starts at 0.
VARYING = {
    "a tick": {"f": "k*y*(1 + time/T)"},
    "a decision on time alone": {"f": "if time < T then k*y else -k*y"},
    "a memory": {"f": "k*y + 0.1*previous(f)*cos(time/T)"},
    "a step of time": {"f": "k*y*(1 + floor(time/T))"},
    "what is heard": {"f": "k*(y - exp(-time/T)*mean(others.x))"},
    "age of what is heard": {"f": "k*(y - mean(others.x + others.v*(time - others.t)))"},
    "a sum over senders": {"f": "k*sum((y - others.x)*(time - others.t)/T)"},
    "a held force": {"flow": "hold(f)*(1 + time/T)"},
    "a continuous spring": {"flow": "hold(f) + k*sin(time/T)*object.x"},
    "a continuous damper": {"flow": "hold(f) + k*time*der(object.x)"},
    "beside a contact": {"f": "max(k*y, 0*k*y)*(1 + time/T)"},
}


# What changes with time and multiplies nothing that moves: a spring stays the spring it is.
CONSTANT = {
    "a force of a clock": {"f": "k*y + k*L*sin(time/T)"},
    "a force without one": {"flow": "hold(f) + k*L*exp(-time/T)"},
    "a decision about a force": {"f": "k*y + (if time < T then k*L else 0*k*L)"},
    "a setting": {"f": "k*y*(1 + T/(2*T))"},
}


def _text(changes: dict[str, str]) -> str:
    return PART.format(**(PLAIN | changes))


@pytest.mark.parametrize("place", VARYING)
def test_a_coefficient_that_changes_with_time_is_refused_by_name(place: str, tmp_path: Path) -> None:
    model = compiled(TOPOLOGY, library(tmp_path, _text(VARYING[place])))
    for requested in (analyze, lambda topology: critical(topology, "w.k")):
        with pytest.raises(ApcError, match=r"topology\.yaml: E810 the equation of .* function of time"):
            requested(model)


@pytest.mark.parametrize("place", CONSTANT)
def test_a_force_that_changes_with_time_moves_no_eigenvalue(place: str, tmp_path: Path) -> None:
    plain, pushed = tmp_path / "plain", tmp_path / "pushed"
    plain.mkdir()
    pushed.mkdir()
    own = analyze(compiled(TOPOLOGY, library(plain, _text({"f": "k*y*3/2"} if place == "a setting" else {}))))
    found = analyze(compiled(TOPOLOGY, library(pushed, _text(CONSTANT[place]))))
    assert not found.linearized
    assert abs(found.spectral_radius - own.spectral_radius) <= (
        found.spectral_radius_error + own.spectral_radius_error
    )


def test_a_contact_that_a_push_decides_about_is_linearized_and_says_so(tmp_path: Path) -> None:
    changes = {"f": "max(k*y + k*L*sin(time/T), 0*k*L)"}
    found = analyze(compiled(TOPOLOGY, library(tmp_path, _text(changes))))
    assert found.linearized
    first, second, _, third, *_ = str(found).splitlines()
    assert first == f"timed: {found.verdict}, linearized at the initial state"
    assert second == "  the initial state is not at rest: 0.1 N acts on device; for the motion over"
    assert third.startswith("  nonlinear topology: the result holds near the initial state")


def test_a_proof_of_a_linearization_says_of_what(tmp_path: Path) -> None:
    changes = {"f": "k*y + k*y*y*y/L/L"}
    found = analyze(compiled(TOPOLOGY, library(tmp_path, _text(changes))), certify=True)
    assert str(found.proof).endswith(" bits, of the linearization")


# What jumps has the same slopes on either side: it is no less linearized for that.
JUMPING = {
    "at a tick": {"f": "k*y + k*L*sign(y)"},
    "in steps": {"f": "k*y + k*L*floor(y/L)"},
    "by a decision": {"f": "k*y + (if y > 0*L then k*L else 0*k*L)"},
    "in what is heard": {"f": "k*y + k*L*sign(mean(others.x))"},
    "in what moves": {"flow": "hold(f) + k*L*sign(object.x)"},
}


@pytest.mark.parametrize("place", JUMPING)
def test_a_force_that_jumps_is_linearized_though_its_slopes_are_the_same(place: str, tmp_path: Path) -> None:
    assert analyze(compiled(TOPOLOGY, library(tmp_path, _text(JUMPING[place])))).linearized
