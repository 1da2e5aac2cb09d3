"""Pairs of groups with a channel of their own, against two links and moments of all patterns of loss."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

import apc
from apc.app.yaml_edit import with_values
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.exports.modelica import modelica
from apc.extensions.loss_models.time_varying_delay import loop_gain
from apc.parameter_values.parameter_names import ParameterRef
from apc.studies.choice import LOSS, choose
from apc.support.not_supported import NotSupportedError
from tests.bruteforce import PacketOutcomes, TopologySource, lossy_frame, states_read
from tests.topologies import TOPOLOGIES, compiled, replaced
from tests.truths import text_of

MS = Fraction(1, 1000)

# Two rooms: pulls within a room come late by 2 ms, those between rooms by 30 ms, and these may get lost.
ROOMS = """\
topology: rooms
clocks: {haptic: 1 ms, network: 8 ms}
peers: {lab: {count: 2}, far: {count: 2}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube:   {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}
  mesh: {type: FullMesh, object: cube, stiffness: 250 N/m, clock: haptic, delay: 1 ms, link: lan}
links:
  lan: {clock: network, delay: 2 ms}
"""
WAN = "delay: 30 ms, loss: 2 %"
PAIRS = replaced(
    ROOMS, ("delay: 2 ms}", f"delay: 2 ms, pairs: {{lab: {{far: {{{WAN}}}}}, far: {{lab: {{{WAN}}}}}}}}}")
)
BETWEEN = "[[1, 3], [1, 4], [2, 3], [2, 4], [3, 1], [3, 2], [4, 1], [4, 2]]"
TWO_LINKS = replaced(
    ROOMS,
    (
        "  mesh: {type: FullMesh, object: cube, stiffness: 250 N/m, clock: haptic, delay: 1 ms, link: lan}\n",
        "".join(
            f"  mesh_{link}: {{type: FullMesh, object: cube, stiffness: 250 N/m, clock: haptic, delay: 1 ms, "
            f"link: {link}}}\n"
            for link in ("lan", "wan")
        ),
    ),
    (
        "delay: 2 ms}",
        "delay: 2 ms, graph: {arcs: [[1, 2], [2, 1], [3, 4], [4, 3]]}}\n"
        f"  wan: {{clock: network, {WAN}, graph: {{arcs: {BETWEEN}}}}}",
    ),
)


def poles(model: Model) -> NDArray[np.complex128]:
    """Return the eigenvalues of the nominal network that are not 0."""
    values = np.array([one.eigenvalue for one in apc.analyze(model).modes for _ in range(one.multiplicity)])
    return values[np.abs(values) > 1e-6]


def distance(one: Model, other: Model) -> float:
    """Return the largest difference between the poles of two models, each with its own partner."""
    between = np.abs(poles(one)[:, None] - poles(other))
    assert between.shape[0] == between.shape[1] > 0
    return float(between[linear_sum_assignment(between)].max())


def growth(model: Model) -> float:
    found = apc.mean_square_stability(model)
    assert found is not None and found.exact and found.mean_square_radius is not None, found
    return found.mean_square_radius


def test_a_pair_replaces_a_second_link_with_arcs() -> None:
    one, two = compiled(PAIRS), compiled(TWO_LINKS)
    assert growth(one) == pytest.approx(growth(two), rel=1e-10)
    assert apc.analyze(one).spectral_radius == pytest.approx(apc.analyze(two).spectral_radius, rel=1e-13)
    assert distance(one, two) < 1e-10


def moments(losses: tuple[float, float], late: tuple[int, int]) -> float:
    """Return the growth of second moments of two users by Kronecker products over all patterns of loss.

    `losses` and `late` (in ms) are those from the first to the second user, and back.
    """
    arcs = [(0, 1), (1, 0)]
    topology = TopologySource(peers=2, late={arc: ms * MS for arc, ms in zip(arcs, late, strict=True)})
    patterns = [*itertools.product((True, False), repeat=2)]
    outcomes = [PacketOutcomes({arcs[0]: there[:1], arcs[1]: there[1:]}) for there in patterns]
    maps = np.array([lossy_frame(topology, outcome)[0] for outcome in outcomes])
    read = states_read(maps)
    maps = maps[:, read][:, :, read]
    still = np.linalg.svd((maps - np.eye(len(read))).reshape(-1, len(read)))
    rest = still[2][: int((still[1] > 1e-9).sum())]  # what some map moves
    chances = [
        np.prod([1 - loss if here else loss for loss, here in zip(losses, there, strict=True)])
        for there in patterns
    ]
    moved = rest @ maps @ rest.T
    operator = sum(chance * np.kron(one, one) for chance, one in zip(chances, moved, strict=True))
    return float(np.abs(np.linalg.eigvals(operator)).max())


@pytest.mark.parametrize(
    ("losses", "late"), [((0.3, 0.0), (8, 8)), ((0.3, 0.05), (8, 16)), ((0.0, 0.6), (16, 8))]
)
def test_second_moments_are_those_of_all_patterns_of_loss(
    losses: tuple[float, float], late: tuple[int, int]
) -> None:
    text = text_of(TopologySource(peers=2, users=({}, {})))
    (one, other), (there, back) = losses, late
    pairs = f"u1: {{u2: {{delay: {there} ms, loss: {one}}}}}, u2: {{u1: {{delay: {back} ms, loss: {other}}}}}"
    model = compiled(replaced(text, ("delay: 8 ms}", f"delay: 8 ms, pairs: {{{pairs}}}}}")))
    assert growth(model) == pytest.approx(moments(losses, late), rel=1e-8)


def test_a_pair_is_set_without_compiling() -> None:
    written = compiled(replaced(PAIRS, ("far: {delay: 30 ms, loss: 2 %}", "far: {delay: 22 ms, loss: 30 %}")))
    named = {"lan.pairs.lab.far.loss": "30 %", "lan.pairs.lab.far.delay": "22 ms"}
    assert growth(apc.set_parameters(compiled(PAIRS), named)) == growth(written)


def test_a_pair_without_delay_follows_the_link() -> None:
    both = replaced(PAIRS, ("lab: {far: {delay: 30 ms, loss: 2 %}}", "lab: {far: {loss: 2 %}}"))
    later = apc.set_parameters(compiled(both), {"lan.delay": "12 ms"})
    written = replaced(
        PAIRS, ("lab: {far: {delay: 30 ms", "lab: {far: {delay: 12 ms"), ("delay: 2 ms, p", "delay: 12 ms, p")
    )
    assert growth(later) == growth(compiled(written))


def test_delays_are_pairs_with_a_delay_only() -> None:
    by_delays, by_pairs = (
        compiled(replaced(ROOMS, ("delay: 2 ms}", f"delay: 2 ms, {text}}}")))
        for text in ("delays: {lab: {far: 30 ms}}", "pairs: {lab: {far: {delay: 30 ms}}}")
    )
    assert apc.analyze(by_delays).spectral_radius == apc.analyze(by_pairs).spectral_radius


def test_consecutive_losses_of_some_pairs_are_not_judged() -> None:
    found = apc.mean_square_stability(compiled(PAIRS))
    assert found is not None and found.losses_in_a_row is not None
    assert "only some pairs of groups lose packets of lan" in found.losses_in_a_row.note


def test_the_limitations_name_the_pair() -> None:
    (first, second) = apc.analyze(compiled(PAIRS)).limitations
    nominal = "every packet has the nominal delay of 30 ms"
    assert first == f"excluded: packet loss (2 %) of lan from lab to far; {nominal}"
    assert "lan from far to lab" in second


def test_modelica_refuses_a_lossy_pair_by_name() -> None:
    with pytest.raises(ApcError, match=r"E955 .*packet loss \(2 %\) of lan from lab to far"):
        modelica(compiled(PAIRS))


ROOM_ARCS = "[[lab, lab, 0.5], [far, far, 0.5], [lab, far], [far, lab]]"
PEER_ARCS = (
    "[[1, 2, 0.5], [2, 1, 0.5], [3, 4, 0.5], [4, 3, 0.5], [1, 3], [1, 4], [2, 3], [2, 4], [3, 1], [3, 2], "
    "[4, 1], [4, 2]]"
)


def graphed(graph: str, text: str = ROOMS) -> Model:
    return compiled(replaced(text, ("delay: 2 ms", f"delay: 2 ms, graph: {graph}")))


def test_a_graph_of_groups_is_that_of_their_peers() -> None:
    by_groups, by_peers = graphed(f"{{arcs: {ROOM_ARCS}}}"), graphed(f"{{arcs: {PEER_ARCS}}}")
    assert distance(by_groups, by_peers) < 1e-12


def test_edges_of_groups_have_both_directions() -> None:
    edges = graphed("{edges: [[lab, lab, 0.5], [far, far, 0.5], [lab, far]]}")
    assert distance(edges, graphed(f"{{arcs: {ROOM_ARCS}}}")) < 1e-12


def test_a_group_that_only_receives_leaves_the_others_as_they_are() -> None:
    """The poles of two users alone are among those with two more that follow them."""
    alone = replaced(
        ROOMS, ("shared: true", "shared: false"), ("lab: {count: 2}, far: {count: 2}", "lab: {count: 2}")
    )
    watched = graphed("{arcs: [[lab, lab], [lab, far]]}", replaced(ROOMS, ("shared: true", "shared: false")))
    among, found = poles(watched), poles(compiled(alone))
    assert found.size and all(np.abs(among - pole).min() < 1e-10 for pole in found)
    with pytest.raises(ApcError, match=r"E801 lab\[1\] and lab\[2\] .*sum\(\), such as FullMesh"):
        graphed("{arcs: [[lab, far]]}", replaced(ROOMS, ("FullMesh", "AveragePosition")))


def test_a_pair_and_a_graph_of_groups_follow_the_counts() -> None:
    arcs = "graph: {arcs: [[lab, lab], [lab, far], [far, lab]]}, "
    text = replaced(PAIRS, ("delay: 2 ms, pairs", f"delay: 2 ms, {arcs}pairs"))
    written = replaced(text, ("lab: {count: 2}", "lab: {count: 3}"), ("far: {count: 2}", "far: {count: 1}"))
    assert growth(apc.set_parameters(compiled(text), {"lab.count": "3", "far.count": "1"})) == growth(
        compiled(written)
    )


def test_a_slower_sender_at_the_rate_of_the_others_is_one_of_them() -> None:
    """A clock of a pair has no effect if the rates are equal."""
    text = (TOPOLOGIES / "sixty-hertz-user.yaml").read_text(encoding="utf-8")
    one = replaced(text, ("  slow: 60 Hz\n", ""), (", pairs: {mobile: {user: {clock: slow}}}", ""))
    equal = apc.set_parameters(compiled(text), {"slow.period": "8 ms"})
    assert distance(equal, compiled(one)) < 1e-10
    slower = apc.analyze(compiled(text))
    assert slower.frame_s == pytest.approx(0.2) and slower.stable


def test_the_shipped_rooms_follow_the_counts_from_two_to_eight_users() -> None:
    model = compiled((TOPOLOGIES / "two-rooms.yaml").read_text(encoding="utf-8"))
    for count in range(1, 5):
        assert growth(apc.set_parameters(model, {"lab.count": str(count), "remote.count": str(count)})) < 1


def test_a_pair_is_written_back_at_its_place() -> None:
    """A delay that followed that of the link gets a key of its own."""
    text = replaced(PAIRS, ("far: {delay: 30 ms, loss: 2 %}", "far: {loss: 2 %}"))
    values = {"lan.pairs.lab.far.loss": "7 %", "lan.pairs.lab.far.delay": "9 ms"}
    found = with_values(text, compiled(text), {ParameterRef(name): value for name, value in values.items()})
    assert "far: {loss: 7 %, delay: 9 ms}" in found


def test_one_loss_of_several_pairs_is_the_loss_that_is_compared() -> None:
    shared = replaced(
        PAIRS,
        (f"{{far: {{{WAN}}}}}", "{far: {loss: q}}"),
        (f"{{lab: {{{WAN}}}}}", "{lab: {loss: q}}"),
        ("peers:", "parameters: {q: 2 %}\npeers:"),
    )
    assert choose(compiled(shared), ())[LOSS].name == "q"
    several = choose(compiled(PAIRS), ())[LOSS]
    assert not several.name and "--over lan.pairs.lab.far.loss" in several.why


def each_pair(channel: str, groups: tuple[str, ...]) -> str:
    """Return the pairs of some groups with a channel, two of which are one group."""
    received = ", ".join(f"{name}: {{{channel}}}" for name in groups)
    return f"pairs: {{{', '.join(f'{name}: {{{received}}}' for name in groups)}}}"


@pytest.mark.parametrize(
    ("channel", "count"),
    [
        ("loss: 20 %", 2),
        ("loss: 20 %, jitter: 1.5 ms", 1),
        ("loss: {p: 10 %, r: 30 %}", 1),
    ],
)
def test_equal_channels_of_all_pairs_are_that_of_the_link(channel: str, count: int) -> None:
    text = replaced(
        ROOMS, ("{lab: {count: 2}, far: {count: 2}}", f"{{lab: {{count: {count}}}, far: {{count: {count}}}}}")
    )
    one, every = (
        compiled(replaced(text, ("delay: 2 ms}", f"delay: 2 ms, {keys}}}")))
        for keys in (channel, each_pair(channel, ("lab", "far")))
    )
    assert growth(every) == pytest.approx(growth(one), rel=1e-9)


def test_a_pair_that_replaces_lost_packets_is_not_judged_and_says_why() -> None:
    found = apc.mean_square_stability(
        compiled(replaced(PAIRS, ("lab: {far: {", "lab: {far: {on_loss: zero, ")))
    )
    assert found is not None and found.stable is None
    assert any(
        "substituted values together with packets of another link or delay" in note for note in found.notes
    )


def test_a_range_that_pairs_follow_is_not_proved_for_changing_delays() -> None:
    text = replaced(PAIRS, ("lab: {far: {delay: 30 ms, ", "lab: {far: {"))
    with pytest.raises(NotSupportedError, match=r"several pairs of groups depend on lan\.delay"):
        loop_gain(compiled(text), ParameterRef("lan.delay"), 2 * MS, 6 * MS)


def test_the_age_of_packets_is_known_if_pairs_differ_in_loss_only() -> None:
    text = (TOPOLOGIES / "three-users-scheduled.yaml").read_text(encoding="utf-8")
    groups = replaced(text, ("user: {count: 3}", "user: {count: 2}\n  far: {count: 1}"))
    lossy = replaced(groups, ("loss: 0 %", "loss: 0 %, pairs: {user: {far: {loss: 5 %}}}"))
    assert distance(compiled(lossy), compiled(groups)) < 1e-12


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("far.lab.loss", "far: {lab: {loss: 0 %}}"),
        ("far.lab.delay", "far: {lab: {delay: 2 ms}}"),
        ("lab.far.jitter", "lab: {far: {jitter: 0 ms}}"),
    ],
)
def test_a_pair_or_a_key_that_is_missing_is_not_another_one(name: str, entry: str) -> None:
    """The pair from the lab has a delay and a loss; what is missing is written into the topology."""
    model = compiled(replaced(PAIRS, (f", far: {{lab: {{{WAN}}}}}", "")))
    with pytest.raises(ApcError, match=r"E622 .* is not in the topology") as error:
        apc.set_parameters(model, {f"lan.pairs.{name}": "1 ms"})
    assert error.value.mistakes[0].fix == f"links: {{lan: {{pairs: {{{entry}}}}}}}"
