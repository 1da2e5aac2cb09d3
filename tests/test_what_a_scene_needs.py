"""What each scene of the library keeps, and that what it doesn't use costs nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.runtime.analysis.analysis import analyze
from apc.runtime.analysis.needs import needs
from tests.topologies import AVERAGE, SCENES, compiled, library, replaced

# Of every scene: motion, delayed forces and packets of a peer of each kind. Counted by hand: two masses or a
# device with a finger move in one axis (4); a force with a delay of one tick is remembered (one each); a
# packet of a delay of k frames is kept k times, for position and velocity each.
KEPT = {
    "experiment-average": [(4, 0, 2)],
    "experiment-mesh": [(4, 0, 2)],
    "finger": [(4, 2, 0)],  # the wall's force, and its position at the tick before
    "mixed-clocks": [(4, 2, 10), (4, 2, 10)],  # 40 ms are five frames
    "ring-of-eight": [(4, 2, 2)],
    "star-lecture": [(4, 2, 4)],  # 20 ms are two frames
    "template": [(4, 2, 2)],
    "three-users-average": [(4, 2, 2)],
    "three-users-mesh": [(4, 2, 2)],
    "users-table": [(4, 2, 2)],
}


def functions(system: CompiledSystem) -> list[Any]:
    """Return all functions of a model."""
    return [
        function
        for kind in system.kinds
        for function in (
            kind.derivative,
            *(clock.tick for clock in kind.clocks),
            *(sending.send for sending in kind.sends),
        )
    ]


def test_every_scene_is_listed() -> None:
    assert sorted(KEPT) == sorted(path.stem for path in SCENES.glob("*.yaml"))


@pytest.mark.parametrize("name", KEPT)
def test_a_scene_keeps_what_it_needs_and_no_more(name: str) -> None:
    system = compile_topology(SCENES / f"{name}.yaml")
    found = needs(system)
    assert [(site.motion, site.remembered, site.packets) for site in found.sites] == KEPT[name]
    assert system.dropped == ()
    # As many equations as states, outputs and channels, and each of them is read.
    for kind in system.kinds:
        assert kind.derivative.numel_out(0) == len(kind.states)
        for clock in kind.clocks:
            read = {hold.output for hold in kind.holds if hold.clock == clock.clock} | set(clock.memories)
            assert read == set(range(len(clock.outputs)))
        for sending in kind.sends:
            heard = {
                receive.channel
                for other in system.kinds
                for clock in other.clocks
                for receive in clock.receives
                if receive.link == sending.link
            }
            assert heard == set(range(len(sending.channels)))


UNUSED = {
    "a clock": (("clocks:\n", "clocks:\n  spare: 3 ms\n"), "nothing ticks with it"),
    "a link with a long delay": (
        ("links:\n", "links:\n  spare: {clock: network, delay: 80 s}\n"),
        "nobody hears what it would carry",
    ),
    "a named number": (("clocks:\n", "parameters: {spare: 3 N/m}\nclocks:\n"), ""),
    "a force between two fixed points": (
        (
            "couplers:\n",
            "couplers:\n  spare: {type: SampledSpringDamper, a: ground, b: ground, stiffness: 1 N/m, "
            "clock: haptic, delay: 5 ms}\n",
        ),
        "nobody reads this held value",
    ),
}


@pytest.mark.parametrize("what", UNUSED)
def test_an_unused_part_changes_nothing_and_costs_nothing(what: str) -> None:
    change, reason = UNUSED[what]
    plain, more = compiled(AVERAGE), compiled(replaced(AVERAGE, change))
    _same(plain, more)
    assert [why for _, why in more.dropped] == ([reason] if reason else [])


def test_a_variable_that_nothing_reads_costs_nothing(tmp_path: Path) -> None:
    """A component of our own that computes and sends what nobody asks for."""
    header = "component: {name}\nextends: SampledSpringDamper\nabout: The same{words}.\n"
    plain = header.format(name="Plain", words="")
    more = header.format(name="More", words=" with a meter") + (
        "parameters: {lag: {unit: s, default: 1}}\nvariables:\n  power: {unit: W}\n  work: {unit: J}\n"
        "equations:\n  - power = f*(sample(der(a.x)) - sample(der(b.x)))\n  - work = power*lag\n"
    )
    own = library(tmp_path, plain, more)
    one, other = (
        compiled(replaced(AVERAGE, ("type: SampledSpringDamper", f"type: {name}")), own)
        for name in ("Plain", "More")
    )
    _same(one, other)


def _same(plain: CompiledSystem, more: CompiledSystem) -> None:
    """Assert that two models are the same functions, states and buffers, and the same answer."""
    assert [one.serialize() for one in functions(more)] == [one.serialize() for one in functions(plain)]
    counted = [[one.n_instructions() for one in functions(system)] for system in (plain, more)]
    assert counted[0] == counted[1]
    assert needs(more) == needs(plain)
    assert [kind.states for kind in more.kinds] == [kind.states for kind in plain.kinds]
    assert analyze(more).to_dict() == analyze(plain).to_dict()
