"""Claims about what is kept from one analysis to the next: it never tells of another scene."""

from __future__ import annotations

import pytest

import apc
from apc.analysis.analysis import Analysis, prepare
from apc.answer import judge
from apc.compiler.compiled import CompiledSystem
from apc.eigen import closing, eigenpairs, modes, peers, rigid, spectrum
from apc.frame import course, exchange, lift, linearize
from apc.vary import bends, delays, evaluator, lags, many
from apc.vary.margins import Margins, margins
from tests.topologies import AVERAGE, compiled, replaced

KEEPING = (
    exchange._exchange,
    linearize._layout,
    linearize._output,
    linearize._of_many,
    lift._known_steps,
    lift._moving_parameters,
    course._swing,
    course._known_rows,
    peers._known_group,
    modes._known_loops,
    closing._known_wiring,
    rigid._before,
    spectrum._relative_to,
    lift._known_unit,
    eigenpairs._known_components,
    delays._pieces,
    delays.borders,
    delays.timing_slopes,
    lags._sheets,
    bends.bends,
    evaluator._evaluator,
    many._family,
)

# Each changes one thing that what is kept hangs on: a number, a time, how many, who hears whom, a law.
CHANGES: dict[str, dict[str, str]] = {
    "as it is": {},
    "another stiffness": {"coordination.stiffness": "700 N/m"},
    "one that frees": {"coordination.stiffness": "0 N/m"},
    "another mass": {"device.mass": "0.2 kg"},
    "no damping": {"device.damping": "0 N*s/m", "cube.damping": "0 N*s/m"},
    "another delay": {"lan.delay": "24 ms"},
    "another computational delay": {"contact.delay": "0 ms"},
    "another period": {"network.period": "4 ms"},
    "other counts": {"user.count": "5"},
}
LATE = ("send", "deliver", "act", "tick")  # values act before the ticks that come with them
TEXTS = {
    "as written": AVERAGE,
    "full mesh": AVERAGE.replace("AveragePosition", "FullMesh"),
    "a ring": replaced(AVERAGE, ("clock: network", "graph: ring, clock: network")),
    "two groups": replaced(
        AVERAGE, ("user: {count: 3}", "user: {count: 2}\n  other: {count: 1, set: {device.mass: 0.3 kg}}")
    ),
}


def forget() -> None:
    for keeping in KEEPING:
        keeping.cache_clear()


def told(system: CompiledSystem, order: tuple[str, ...] | None = None) -> Analysis:
    return judge(system, prepared=None if order is None else prepare(system, order=order))


def same(one: Analysis, other: Analysis) -> None:
    assert one.verdict == other.verdict
    assert one.spectral_radius == other.spectral_radius
    assert one.spectral_radius_error == other.spectral_radius_error
    assert (one.rigid_modes, one.translations, one.unfelt) == (
        other.rigid_modes,
        other.translations,
        other.unfelt,
    )
    assert repr(one.modes) == repr(other.modes)


@pytest.mark.parametrize("text", TEXTS)
def test_a_scene_after_others_is_told_as_it_is_alone(text: str) -> None:
    """Bit for bit, in either order; each scene is asked twice in a row, and of another order of events."""
    plain = compiled(TEXTS[text])
    systems = [apc.set_parameters(plain, changed) for changed in CHANGES.values()]
    alone = []
    for system in systems:
        forget()
        alone.append((told(system), told(system, LATE)))
    forget()
    for places in (range(len(systems)), reversed(range(len(systems)))):
        for place in places:
            for _ in range(2):
                same(told(systems[place]), alone[place][0])
            same(told(systems[place], LATE), alone[place][1])


def test_scenes_of_equal_states_and_other_laws_are_told_apart() -> None:
    """One after another, as a process that serves many does."""
    systems = [compiled(text) for text in TEXTS.values()]
    alone = []
    for system in systems:
        forget()
        alone.append(told(system))
    forget()
    for place in (0, 1, 0, 2, 3, 1, 2, 0, 3):
        same(told(systems[place]), alone[place])


def test_margins_and_many_points_after_other_scenes_are_told_as_alone() -> None:
    """Bit for bit, in either order."""

    def asked(system: CompiledSystem) -> tuple[Margins, bytes]:
        found = apc.analyze_many(system, {"contact.stiffness": [300.0, 700.0, 1500.0]})
        return margins(system), found.spectral_radius.tobytes() + found.frequency_hz.tobytes()

    plain = compiled(AVERAGE)
    changes = ("as it is", "another stiffness", "another mass", "another delay", "another period")
    systems = [apc.set_parameters(plain, CHANGES[name]) for name in changes]
    alone = []
    for system in systems:
        forget()
        alone.append(asked(system))
    assert len({radii for _, radii in alone}) == len(alone)
    forget()
    for places in (range(len(systems)), reversed(range(len(systems)))):
        for place in places:
            assert asked(systems[place]) == alone[place]
