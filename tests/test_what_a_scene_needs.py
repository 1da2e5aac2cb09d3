"""What each scene of the library keeps, and that what it doesn't use costs nothing."""

from __future__ import annotations

import re
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from apc.analysis.analysis import analyze
from apc.analysis.needs import needs
from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.bench.needs import Account, accounts
from tests.topologies import AVERAGE, SCENES, compiled, library, replaced

# Of every scene: motion, delayed forces and packets of a peer of each kind. Counted by hand: two masses or a
# device with a finger move in one axis (4); a force with a delay of one tick is remembered (one each); a
# packet of a delay of k frames is kept k times, for position and velocity each.
KEPT = {
    "client-server": [(2, 2, 3), (4, 3, 3)],  # forces are held to be sent, and sent as well
    "experiment-average": [(4, 0, 2)],
    "experiment-mesh": [(4, 0, 2)],
    "finger": [(4, 2, 0)],  # the wall's force, and its position at the tick before
    "lifted-box": [(4, 2, 2)],
    "lossy-average": [(4, 2, 2)],
    "mixed-clocks": [(4, 2, 10), (4, 2, 10)],  # 40 ms are five frames
    "planar-users": [(8, 4, 4)],  # the paper's, along either axis
    "ring-of-eight": [(4, 2, 2)],
    "star-lecture": [(4, 2, 4)],  # 20 ms are two frames
    "template": [(4, 2, 2)],
    "three-users-average": [(4, 2, 2)],
    "three-users-mesh": [(4, 2, 2)],
    "three-users-predicted": [(4, 2, 2)],
    "three-users-scheduled": [(4, 2, 1)],  # no velocity is sent
    "two-handed-tool": [(6, 2, 2)],  # two devices and a copy; the tool is midway
    "two-users-damped": [(4, 2, 2)],
    "two-users-proxies": [(4, 2, 2)],
    "two-users-reported": [(4, 5, 1)],  # the mean as it grows, and what was told, at either clock
    "two-users-filtered-waves": [(4, 5, 2)],  # as below, and the filter
    "two-users-waves": [(4, 4, 2)],  # the outgoing wave until it is sent, and the point that moves
    "unlike-devices": [(4, 2, 2)],
    "users-table": [(4, 2, 2)],
}
# Schemes that remember what their laws need, which are played by hand in test_schemes_in_time.
IN_TIME = (
    "god-object",
    "limited-motor",
    "stiff-wall-passivity",
    "two-users-dead-reckoning",
    "two-users-passivity",
    "two-users-set-position",
)
# The equations of a peer: of masses (3 each), contact, coordination (4), hands (1 each), and of connections:
# an equal position a flange that joins a mass, and a sum of forces a mass.
PAPER, EXPERIMENT, ARMED = 6 + 3 + 4 + 3 + 2, 6 + 5 + 4 + 1 + 4 + 2, 6 + 3 + 4 + 1 + 4 + 2
WRITTEN: dict[str, int | list[int]] = {
    "experiment-average": EXPERIMENT,
    "experiment-mesh": EXPERIMENT,
    "finger": 9 + 4 + 5 + 2 + 1 + 5 + 3,  # three masses, motors and a grip, a wall, a pad, a hand
    "client-server": [3 + 4 + 1 + 1, PAPER],
    "lifted-box": 6 + 3 * 1 + 3 + 4 + 1 + 7 + 2,
    "planar-users": 2 * PAPER,
    "star-lecture": ARMED,
    "two-users-proxies": 6 + 5 + 3 + 1 + 1 + 6 + 2,  # the proxy is a mass, and the device feels it nowhere
    "three-users-predicted": 6 + 3 + 3 + 3 + 2,
    "two-handed-tool": 4 * 3 + 3 + 3 + 4 + 6 + 4,
    "two-users-damped": 6 + 3 + 2 + 3 + 2,
    "two-users-filtered-waves": 6 + 3 + 7 + 3 + 2,
    "two-users-reported": 6 + 3 + 8 + 3 + 2,
    "two-users-waves": 6 + 3 + 7 + 3 + 2,
    "users-table": ARMED,
}
LATE = {"mixed-clocks": ("wan", 40), "ring-of-eight": ("ring", 8), "star-lecture": ("lecture", 20)}
# What is left out beside what is the same as another, and why it is no loss.
UNREAD = {  # forces within one rigid body
    "finger": ("finger.tip.flange.f", "device.grip.f"),
    "two-handed-tool": ("der(tool.v)", "tool.flange.f", "right.flange.f", "left.flange.f"),
}
MADE = {"two-handed-tool": 1}  # equations that nobody wrote: the bar's, differentiated, for der(tool.v)
# What is remembered to be looked at again, and what is held at once, until it is sent.
AGAIN = ("wall.x", "coordination.heard", "coordination.p(", "coordination.shown", "coordination.seen")
SENT = ("coordination.out", "coordination.pull", "coordination.told")
HELD = ("client-server", "two-users-reported", "two-users-waves", "two-users-filtered-waves")


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
    assert sorted([*KEPT, *IN_TIME]) == sorted(path.stem for path in SCENES.glob("*.yaml"))


@pytest.mark.parametrize("name", KEPT)
def test_a_scene_keeps_what_it_needs_and_no_more(name: str) -> None:
    system = compile_topology(SCENES / f"{name}.yaml")
    found = needs(system)
    assert [(site.motion, site.remembered, site.packets) for site in found.sites] == KEPT[name]
    assert system.dropped == ()
    listed = accounts(SCENES / f"{name}.yaml")
    of_kinds = WRITTEN.get(name, PAPER)
    for place, (one, site, kind) in enumerate(zip(listed, found.sites, system.kinds, strict=True)):
        assert len(one.motion) == site.motion
        assert len(one.remembered) == site.remembered
        assert len(one.packets) * _frames(one) == site.packets
        assert one.unread == UNREAD.get(name, ())
        assert one.written == (of_kinds if isinstance(of_kinds, int) else of_kinds[place])
        assert one.written + MADE.get(name, 0) == one.computed + len(one.same) + len(one.unread)
        # The same as another is a position or a velocity at a joint, the force on its other side, or what a
        # motor or a stop without limits gives.
        assert all(re.search(r"\.([xvf](\[[12]\])?|given|stopped)\Z", signal) for signal, _ in one.same)
        assert {name for name, _ in one.without} <= {out for clock in kind.clocks for out in clock.outputs}
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


def _frames(account: Account) -> int:
    """Return of how many frames the packets are kept, as the account words it."""
    found = {re.search(r"of (\d+) frames", signal) for signal, _ in account.packets}
    assert len(found) < 2 or None not in found
    return max((int(one.group(1)) if one else 1 for one in found), default=0)


@pytest.mark.parametrize("name", KEPT)
def test_whatever_is_kept_says_why(name: str) -> None:
    link, late = LATE.get(name, ("lan", 8))
    for place, one in enumerate(accounts(SCENES / f"{name}.yaml")):
        tick = place + 1 if name == "mixed-clocks" else 1  # far from the others the forces tick every 2 ms
        for signal, reason in one.remembered:
            expected = f"acts {tick} ms after its tick"
            if signal.startswith(AGAIN):
                expected = "is looked at again at the next tick"
            elif signal.startswith(SENT):
                expected = "acts on until the next tick"
            assert reason == expected
        assert {reason for _, reason in one.packets} <= {f"{link} is {late} ms late"}
        assert {reason for _, reason in one.without} <= {"acts at once: nothing to remember"}
        assert bool(one.without) == (name.startswith("experiment") or name in HELD)


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


@pytest.mark.parametrize("name", KEPT)
def test_unused_parts_change_nothing_and_cost_nothing_in_any_scene(name: str, tmp_path: Path) -> None:
    path = SCENES / f"{name}.yaml"
    text = path.read_text(encoding="utf-8")
    spare = {
        "clocks": "spare_clock: 3 ms",
        "parameters": "spare_number: 3 N/m",
        "links": "spare_link: {clock: haptic, delay: 80 s}",
        "couplers": "spare_force: {type: SampledSpringDamper, a: ground, b: ground, stiffness: 1 N/m, "
        "clock: haptic, delay: 5 ms}",
    }
    for section, entry in spare.items():
        text = _with(text, section, entry)
    for table in SCENES.glob("*.csv"):
        shutil.copy(table, tmp_path)
    (tmp_path / path.name).write_text(text, encoding="utf-8")
    more = compile_topology(tmp_path / path.name)
    _same(compile_topology(path), more)
    assert sorted({reason for _, reason in more.dropped}) == [
        "nobody hears what it would carry",
        "nobody reads this held value",
        "nothing ticks with it",
    ]


def _with(text: str, section: str, entry: str) -> str:
    """Return a topology with one more entry in a section, there or not, on one line or several."""
    found = re.search(rf"^{section}:( *{{)?", text, re.MULTILINE)
    if found is None:
        return f"{text}\n{section}:\n  {entry}\n"
    end = found.end()
    if found.group(1):
        return f"{text[:end]}{entry}, {text[end:]}"
    end = text.index("\n", end)
    return f"{text[:end]}\n  {entry}{text[end:]}"


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


def _played(system: CompiledSystem) -> list[Any]:
    """Return the functions that a simulation plays a frame with."""
    population = prepare(system, Settings(Fraction(1, 20), jit=False)).population
    segments = [one for member in population.members for one in member.program.segments]
    return [*(one.kernel for one in segments), *population.hearing.functions]


def _instructions(function: Any) -> int:
    """Return how many instructions a function has, with those that it calls."""
    every = [function, *function.find_functions(-1)]
    return sum(one.n_instructions() for one in every if one.is_a("SXFunction") or one.is_a("MXFunction"))


def _same(plain: CompiledSystem, more: CompiledSystem) -> None:
    """Assert that two models are the same functions, states and buffers, and the same answer."""
    assert [one.serialize() for one in functions(more)] == [one.serialize() for one in functions(plain)]
    counted = [[one.n_instructions() for one in functions(system)] for system in (plain, more)]
    assert counted[0] == counted[1]
    assert needs(more) == needs(plain)
    played, alike = (_played(system) for system in (plain, more))
    assert [one.serialize() for one in alike] == [one.serialize() for one in played]
    assert sum(map(_instructions, alike)) == sum(map(_instructions, played)) > 0
    assert [kind.states for kind in more.kinds] == [kind.states for kind in plain.kinds]
    assert analyze(more).to_dict() == analyze(plain).to_dict()
