"""Claims about `apc.compiler.scene.channels`: what a link can say of its packets, and what it is told."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from apc.compiler.compiled import Channel, CompiledSystem, Loss
from apc.compiler.errors import ApcError, Place
from apc.compiler.language.recordings import read_trace
from apc.compiler.language.tables import MOST_MISTAKES
from apc.compiler.pipeline import compile_topology
from apc.compiler.scene.channels import SceneChannel
from apc.compiler.store import save
from apc.compiler.view.stages import describe
from apc.inputs import load_fresh
from tests.topologies import AVERAGE, compiled, replaced, scene, told

LINK = "  lan: {clock: network, delay: 8 ms}"
AT = "scene.yaml:15:"
NOWHERE = Place("scene.yaml", 15, 45)


def says(text: str) -> str:
    """Return the three-users scene with a link that says more."""
    return replaced(AVERAGE, (LINK, f"{LINK[:-1]}, {text}}}"))


def channel(text: str) -> SceneChannel:
    [link] = scene(says(text)).links
    assert link.channel is not None
    return link.channel


def compiled_channel(system: CompiledSystem) -> Channel:
    [link] = system.links
    assert link.channel is not None
    return link.channel


def numbers(found: SceneChannel) -> list[Fraction]:
    return [value.number for _, value in found.loss]


def written(folder: Path, text: str) -> Path:
    (folder / "delays.csv").write_text(text, encoding="utf-8")
    return folder / "delays.csv"


# ---- what can be said ----


def test_a_link_that_says_nothing_is_reliable() -> None:
    assert scene(AVERAGE).links[0].channel is None
    system = compiled(AVERAGE)
    assert system.links[0].channel is None
    assert not [one.name for one in system.parameters if "lan." in one.name]


@pytest.mark.parametrize("text", ["2 %", "2%", "0.02", "1/50", "2 percent", "drop", "2*drop - 0.02"])
def test_a_probability_is_a_percentage_a_number_or_an_expression(text: str) -> None:
    given = says(f"loss: {text}").replace("clocks:", "parameters: {drop: 2 %}\nclocks:", 1)
    [link] = scene(given).links
    assert link.channel is not None
    assert numbers(link.channel) == [Fraction(1, 50), Fraction(49, 50), 1, 0]


def test_what_gemodel_leaves_out_is_as_in_netem() -> None:
    """tc-netem(8): the defaults are r = 1-p, 1-h = 1 and 1-k = 0."""
    assert numbers(channel("loss: {p: 1 %}")) == [Fraction(1, 100), Fraction(99, 100), 1, 0]
    assert numbers(channel("loss: {p: 1 %, r: 25 %}")) == [Fraction(1, 100), Fraction(1, 4), 1, 0]
    whole = channel("loss: {p: 1 %, r: 25 %, 1-h: 90 %, 1-k: 0.1 %}")
    assert numbers(whole) == [Fraction(1, 100), Fraction(1, 4), Fraction(9, 10), Fraction(1, 1000)]


def test_a_link_keeps_holding_newest_and_uniform_unless_it_says_otherwise() -> None:
    found = channel("jitter: 2 ms")
    assert (found.distribution, found.reorder, found.on_loss) == ("uniform", "newest", "hold")
    found = channel("jitter: 2 ms, loss: 1 %, distribution: pareto, reorder: all, on_loss: zero")
    assert (found.distribution, found.reorder, found.on_loss) == ("pareto", "all", "zero")


def test_its_numbers_are_parameters_and_timings_of_the_model() -> None:
    system = compiled(says("loss: {p: 1 %, 1-h: 50 %}, jitter: 2 ms"))
    found = compiled_channel(system)
    assert found.loss == Loss("lan.loss.p", "lan.loss.r", "lan.loss.1-h", "lan.loss.1-k")
    assert found.jitter == "lan.jitter"
    value = {one.name: (one.value, one.formula and one.formula.text) for one in system.parameters}
    assert value["lan.loss.p"] == (0.01, None)
    assert value["lan.loss.r"] == (0.99, "1 - lan.loss.p")
    assert value["lan.loss.1-h"] == (0.5, None)
    assert {one.name: one.value for one in system.timings}["lan.jitter"] == Fraction(1, 500)


def test_a_link_nobody_hears_has_no_numbers_in_the_model() -> None:
    more = replaced(AVERAGE, (LINK, f"{LINK}\n  wan: {{clock: network, loss: 2 %, jitter: 1 ms}}"))
    system = compiled(more)
    names = [one.name for one in (*system.parameters, *system.timings)]
    assert not [name for name in names if name.startswith("wan")]


def test_a_channel_does_not_change_what_a_peer_computes() -> None:
    plain, more = compiled(AVERAGE), compiled(says("loss: 2 %, jitter: 1 ms"))
    for one, other in zip(plain.kinds, more.kinds, strict=True):
        assert one.parameters == other.parameters
        assert [tick.tick.serialize() for tick in one.clocks] == [
            tick.tick.serialize() for tick in other.clocks
        ]


# ---- a trace ----


def test_a_trace_is_a_column_of_delays_lost_ones_infinite(tmp_path: Path) -> None:
    path = written(tmp_path, 'delay [ms]\n8\n8.25\nlost\n""\n\n12e0\n')
    assert read_trace(path, NOWHERE).delays.tolist() == [0.008, 0.00825, math.inf, math.inf, 0.012]
    path = written(tmp_path, "packet,delay [us],note\n1,500,\n2,,gone\n3, lost ,\n4,0,late\n")
    assert read_trace(path, NOWHERE).delays.tolist() == [0.0005, math.inf, math.inf, 0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "delay [ms]\n8\n-1\n",
            ":3:1: E703 a delay wants a time from 0 to 1e+09 s, or lost, got -1.",
        ),
        (
            "n,delay [ms]\n1,8\n2,soon\n",
            ":3:3: E703 a delay wants a time from 0 to 1e+09 s, or lost, got soon.",
        ),
        ("delay [ms]\n1e308\n", ":2:1: E703 a delay wants a time from 0 to 1e+09 s, or lost, got 1e308."),
        (
            "n,delay [ms]\n1,nan\n",
            ":2:3: E703 a delay wants a time from 0 to 1e+09 s, or lost, got nan.",
        ),
        (
            "n,delay [ms]\n1,inf\n",
            ":2:3: E703 a delay wants a time from 0 to 1e+09 s, or lost, got inf.",
        ),
        ("n,delay [ms]\n1\n", ":2:1: E703 the row has 1 cells and there are 2 headings."),
        (
            "delay\n8\n",
            ":1:1: E702 a trace wants a column delay in a unit of time, got "
            "delay without a unit. Write: delay [ms]",
        ),
        (
            "n,late [ms]\n1,8\n",
            ":1:1: E702 a trace wants a column delay in a unit of time, got n, late. Write: delay [ms]",
        ),
        (
            "n,delay [mm]\n1,8\n",
            ":1:3: E702 a trace wants a column delay in a unit of time, got delay in mm. Write: delay [ms]",
        ),
        ("delay [ms]\n", ":2:1: E703 the table has headings but no rows."),
        ("", ":1:1: E702 the table has no headings. Write: device.mass [kg]"),
    ],
)
def test_a_bad_trace_is_told_with_its_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    assert told(read_trace, path, NOWHERE) == [f"{path}{message}"]


def test_a_wrong_column_is_told_only_so_often(tmp_path: Path) -> None:
    path = written(tmp_path, "delay [ms]\n" + "x\n" * 1000)
    assert len(told(read_trace, path, NOWHERE)) == MOST_MISTAKES


def test_a_trace_stands_beside_its_topology_and_its_digest_in_the_model(tmp_path: Path) -> None:
    written(tmp_path, "delay [ms]\n8\nlost\n20\n")
    (tmp_path / "scene.yaml").write_text(says("trace: delays.csv"), encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    trace = compiled_channel(system).trace
    assert trace is not None
    assert trace.tolist() == [0.008, math.inf, 0.02]
    assert any(name.endswith("delays.csv") for name, _ in system.origin.texts)


def test_a_trace_that_is_not_there_is_told_where_it_is_named() -> None:
    assert told(scene, says("trace: delays.csv")) == [f"{AT}45: E701 the table delays.csv does not exist."]


# ---- what can't be said ----


@pytest.mark.parametrize(
    ("text", "messages"),
    [
        ("loss: 150 %", ["44: E261 loss wants PROBABILITY, got 150 %."]),
        ("loss: -1 %", ["44: E261 loss wants PROBABILITY, got -1 %."]),
        ("loss: 2", ["44: E261 loss wants PROBABILITY, got 2. Write: loss: 2 %"]),
        ("loss: peers", ["44: E261 loss wants PROBABILITY, got peers."]),
        ("loss: 2 ms", ["44: E204 loss wants %, got 2 ms."]),
        ("loss: nan", ["44: E221 loss wants %, got nan. Write: loss: 1 %"]),
        ("loss: rare", ["44: E206 loss names rare, which is no parameter here; there are: peers."]),
        ("loss: [1 %]", ["44: E203 loss wants a single value, got a list. Write: loss: 1 %"]),
        ("loss: {r: 25 %}", ["44: E201 the loss of lan has no p. Write: loss: {p: 1 %, r: 25 %}"]),
        ("loss: {p: 1 %, h: 0 %}", ["53: E202 the loss of lan has no key h; there are: p, r, 1-h, 1-k."]),
        (
            "loss: {p: 101 %, 1-k: 3}",
            [
                "48: E261 p wants PROBABILITY, got 101 %.",
                "60: E261 1-k wants PROBABILITY, got 3. Write: 1-k: 3 %",
            ],
        ),
        ("jitter: -5 ms", ["46: E207 jitter wants 0 ms or more, got -5 ms."]),
        ("jitter: 5", ["46: E204 jitter wants ms, got 5 (no unit). Write: jitter: 5 ms"]),
        (
            "jitter: 5 ms, distribution: gauss",
            [
                "66: E206 distribution wants uniform or normal or pareto, got "
                "gauss. Write: distribution: uniform"
            ],
        ),
        ("loss: 1 %, on_loss: drop", ["58: E206 on_loss wants hold or zero, got drop. Write: on_loss: hold"]),
        (
            "distribution: normal",
            [
                "52: E262 lan says distribution but has no jitter that this would be "
                "about. Write: jitter: 2 ms"
            ],
        ),
        (
            "loss: 1 %, reorder: all",
            [
                "58: E262 lan says reorder but has no jitter or trace that this would "
                "be about. Write: jitter: 2 ms"
            ],
        ),
        (
            "jitter: 2 ms, on_loss: zero",
            ["61: E262 lan says on_loss but has no loss or trace that this would be about. Write: loss: 2 %"],
        ),
        ("los: 2 %", ["38: E202 lan (Link) has no key los; the nearest is loss. Write: loss"]),
    ],
)
def test_a_slip_is_told_once_where_it_is(text: str, messages: list[str]) -> None:
    probability = "a probability, 0 % to 100 %"
    expected = [f"{AT}{message.replace('PROBABILITY', probability)}" for message in messages]
    assert told(scene, says(text)) == expected


def test_a_negative_delay_is_told() -> None:
    text = says("loss: 1 %").replace("delay: 8 ms,", "delay: -8 ms,")
    assert told(scene, text) == [f"{AT}32: E207 delay wants 0 ms or more, got -8 ms."]


@pytest.mark.parametrize("more", ["loss: 1 %", "jitter: 1 ms", "delays: {user: {user: 3 ms}}"])
def test_a_trace_stands_alone(tmp_path: Path, more: str) -> None:
    written(tmp_path, "delay [ms]\n8\n")
    (tmp_path / "scene.yaml").write_text(says(f"trace: delays.csv, {more}"), encoding="utf-8")
    with pytest.raises(
        ApcError, match="E262 lan has a trace, which says when every packet arrives: it can't"
    ):
        compile_topology(tmp_path / "scene.yaml")


# ---- kept and shown ----


def test_a_model_on_disk_keeps_its_channels(tmp_path: Path) -> None:
    written(tmp_path, "delay [ms]\n8\nlost\n")
    more = (
        f"{LINK[:-1]}, loss: 2 %, jitter: 1 ms, on_loss: zero}}\n  wan: {{clock: network, trace: delays.csv}}"
    )
    text = replaced(AVERAGE, (LINK, more))
    text = text.replace(
        "link: lan}",
        "link: lan}\n  again: {type: FullMesh, object: cube, stiffness: 1 N/m, clock: haptic, link: wan}",
        1,
    )
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    save(system, tmp_path / "scene.apc")
    lan, wan = (link.channel for link in load_fresh(tmp_path / "scene.apc").links)
    assert lan is not None
    assert wan is not None
    assert (lan.loss, lan.jitter, lan.on_loss) == (
        Loss("lan.loss", "lan.loss.r", "lan.loss.1-h", "lan.loss.1-k"),
        "lan.jitter",
        "zero",
    )
    assert lan.trace is None
    assert wan.loss is None
    np.testing.assert_array_equal(wan.trace, [0.008, math.inf])
    save(load_fresh(tmp_path / "scene.apc"), tmp_path / "again.apc")
    assert (tmp_path / "again.apc").read_bytes() == (tmp_path / "scene.apc").read_bytes()


def test_it_is_listed_and_drawn_in_words() -> None:
    text = says("loss: {p: 1 %, r: 25 %}, jitter: 2 ms, distribution: pareto, reorder: all")
    lines = (
        "loss: p 1 %, r 25 %, 1-h 100 %, 1-k 0 %",
        "jitter 2 ms, pareto",
        "the packet that arrived last counts; a lost one changes nothing",
    )
    assert channel(text.partition("8 ms, ")[2].partition("}\n")[0]).told == lines
    listed = describe(scene(text))
    assert all(f"  {line}\n" in f"{listed}\n" for line in lines)


# ---- what can be studied ----


@pytest.mark.parametrize(
    ("said", "name", "span", "ends"),
    [
        ("loss: 10 %", "lan.loss", "0 %, 60 %", (Fraction(0), Fraction(3, 5))),
        ("loss: {p: 1 %, r: 10 %}", "lan.loss.r", "2 %, 0.9", (Fraction(1, 50), Fraction(9, 10))),
        ("jitter: 2 ms", "lan.jitter", "0 ms, 4 ms", (Fraction(0), Fraction(1, 250))),
    ],
)
def test_what_a_link_loses_by_can_be_an_axis_of_a_study(
    said: str, name: str, span: str, ends: tuple[Fraction, Fraction]
) -> None:
    [x, _] = scene(_with_study(says(said), f"{name}: [{span}]")).region
    assert (x.parameter, x.low, x.high) == (name, *ends)


def test_an_axis_of_losses_is_a_probability_that_follows_from_no_other() -> None:
    [beyond] = told(scene, _with_study(says("loss: 10 %"), "lan.loss: [0 %, 120 %]"))
    assert beyond.endswith("E207 lan.loss wants 100 % or less, got 120 %.")
    [follows] = told(scene, _with_study(says("loss: 10 %"), "lan.loss.r: [1 %, 90 %]"))
    assert follows.endswith("the nearest is lan.loss. Write: lan.loss")


def _with_study(text: str, axis: str) -> str:
    before = text.partition("studies:")[0]
    return (
        f"{before}studies: {{region: {{x: {{{axis}}}, y: {{coordination.stiffness: [0 N/m, 1500 N/m]}}}}}}\n"
    )
