"""An expression means in every place what a variable of its name means there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from apc.analysis.analysis import analyze
from apc.analysis.selfcheck import check_frame
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology

SCENE = """
topology: places
library: ./parts
clocks: {tick: 1 ms, slow: 4 ms, packets: 2 ms}
peers: {one: {count: 1}, two: {count: 2, set: {device.mass: 0.15 kg}}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 mm}
  cube:   {mass: 0.2 kg, damping: 3 N*s/m, x: 2 mm}
couplers: {own: {type: Own, a: device, b: cube, clock: tick, slow: slow, link: lan}}
links: {lan: {clock: packets, delay: 2 ms}}
"""
OWN = """
component: Own
connectors: {{a: Flange, b: Flange}}
sends: {{sent: '{sent}'}}
parameters:
  K: {{unit: N/m, default: 100 N/m}}
  L: {{unit: m, default: 1 mm}}
  T: {{unit: s, default: 1 ms}}
  late: {{unit: s, default: 1.5 ms}}
  clock: clock
  slow: clock
  link: link
variables:
  y: {{unit: m, start: 1 mm}}
  z: {{unit: m, start: 2 mm}}
  before: {{unit: m, start: {start}}}
  moving: {{unit: m}}
equations:
  - y = 0.5*previous(y) + 0.5*sample(a.x, clock)
  - z = 1.1*sample(b.x, clock) - 0.1*previous(z)
  - before = {clocked}
  - moving = {continuous}
  - a.f = {force}
  - b.f = -a.f
"""
# At the start y = 1 mm and z = 2 mm: an expression, and its value there.
CLOCKED = {
    "y": "1 mm",
    "2*y - z": "0 mm",
    "-z": "-2 mm",
    "y*z/L": "2 mm",
    "max(y, z + L)": "3 mm",
    "abs(y - z)": "1 mm",
    "if y < z then 3*y else z/2": "3 mm",
    "L*sin((y + z)/L)": "0.1411200080598672 mm",
    "sqrt(y*y + z*z)": "2.23606797749979 mm",
    "(y + z)^2/(y - 3*z)": "-1.8 mm",
}
CONTINUOUS = ("a.x", "2*a.x - b.x", "a.x*b.x/L", "T*der(a.x) + b.x", "min(a.x, b.x - L)", "L*tanh(a.x/L)")
PLAIN = "hold(K*(sample(a.x, clock) - mean(others.sent)))"

# A force with an expression in some place of it, and what is sent.
PLACES: dict[str, Callable[[str], tuple[str, str]]] = {
    "hold": lambda e: (f"K*hold({e})", "sample(a.x)"),
    "a factor of a hold": lambda e: (f"hold(K*({e}))", "sample(a.x)"),
    "hold with a delay": lambda e: (f"K*hold({e}, T)", "sample(a.x)"),
    "sample of a hold": lambda e: (f"hold(K*sample(hold({e}), clock))", "sample(a.x)"),
    "sample of a hold at another clock": lambda e: (
        f"hold(K*sample(2*hold({e}) - b.x, slow))",
        "sample(a.x)",
    ),
    "previous": lambda e: (f"hold(K*(y + previous({e})))", "sample(a.x)"),
    "initial": lambda e: (f"hold(K*y*initial({e})/L)", "sample(a.x)"),
    "a condition": lambda e: (f"hold(if ({e}) > 1.5*L then K*y else K*z)", "sample(a.x)"),
    "a branch": lambda e: (f"hold(if y < z then K*({e}) else K*z)", "sample(a.x)"),
    "max": lambda e: (f"hold(K*max(y, 1.5*({e})))", "sample(a.x)"),
    "what is sent": lambda e: (PLAIN, f"sample(hold({e}))"),
    "a sum over the others": lambda e: (f"hold(K*sum(others.sent - ({e})))", "sample(a.x)"),
    "an edge to each of the others": lambda e: (
        f"hold(sum(K*L*tanh((others.sent - ({e}))/L)))",
        "sample(a.x)",
    ),
}
MOVING: dict[str, Callable[[str], tuple[str, str]]] = {
    "sample": lambda e: (f"hold(K*sample({e}, clock))", "sample(a.x)"),
    "sample at another clock": lambda e: (f"hold(K*sample({e}, slow))", "sample(a.x)"),
    "what is sent": lambda e: (PLAIN, f"sample({e})"),
    "what is sent, twice": lambda e: (PLAIN, f"2*sample({e}) - sample(b.x)"),
    "the force": lambda e: (f"K*({e})", "sample(a.x)"),
}


def scene(folder: Path, force: str, sent: str, clocked: str, start: str, continuous: str) -> CompiledSystem:
    (folder / "parts").mkdir(exist_ok=True)
    text = OWN.format(force=force, sent=sent, clocked=clocked, start=start, continuous=continuous)
    (folder / "parts" / "own.yaml").write_text(text, encoding="utf-8")
    (folder / "scene.yaml").write_text(SCENE, encoding="utf-8")
    system = compile_topology(folder / "scene.yaml")
    check_frame(system)
    return system


def radius(folder: Path, place: tuple[str, str], **variables: str) -> float:
    return analyze(scene(folder, *place, **variables)).spectral_radius


@pytest.mark.parametrize(("number", "place"), list(enumerate(PLACES)))
def test_an_expression_of_a_clock_means_what_a_variable_means(
    number: int, place: str, tmp_path: Path
) -> None:
    """Every other expression in a place, the others in the next one: each stands in six or more."""
    for expression, start in list(CLOCKED.items())[number % 2 :: 2]:
        variables = {"clocked": expression, "start": start, "continuous": "a.x"}
        written = radius(tmp_path, PLACES[place](expression), **variables)
        named = radius(tmp_path, PLACES[place]("before"), **variables)
        assert written == pytest.approx(named, rel=1e-12), expression


@pytest.mark.parametrize("place", MOVING)
def test_a_continuous_expression_means_what_a_variable_means(place: str, tmp_path: Path) -> None:
    for expression in CONTINUOUS:
        variables = {"clocked": "y", "start": "0 m", "continuous": expression}
        if place == "the force" and "der" not in expression:
            continue
        written = radius(tmp_path, MOVING[place](expression), **variables)
        named = radius(tmp_path, MOVING[place]("moving"), **variables)
        assert written == pytest.approx(named, rel=1e-12), expression


def test_a_delay_is_an_expression_of_parameters(tmp_path: Path) -> None:
    variables = {"clocked": "y", "start": "0 m", "continuous": "a.x"}
    named = radius(tmp_path, ("hold(K*y, late)", "sample(a.x)"), **variables)
    for delay in ("T + T/2", "3*T/2", "late - 0*T", "min(late, 2*T)", "if L > 0 then late else T"):
        assert radius(tmp_path, (f"hold(K*y, {delay})", "sample(a.x)"), **variables) == pytest.approx(
            named, rel=1e-12
        )


@pytest.mark.parametrize(
    ("force", "sent", "told"),
    [
        ("hold(K*y, T*y/L)", "sample(a.x)", "E505 the delay of a hold wants parameters only, got y."),
        ("hold(K*y, -T)", "sample(a.x)", "E809 delay of own.held1 wants 0 s or more, got -0.001 s."),
        (
            "hold(K*L)",
            "sample(a.x)",
            "E505 hold(own.K*own.L, 0) holds own.K*own.L, which is continuous already. Write: own.K*own.L",
        ),
        (
            "hold(K*previous(y + sample(a.x, clock)))",
            "sample(a.x)",
            "E505 sample(a.x, clock) inside previous wants a variable. "
            "Write: y1 = sample(a.x, clock), and y1: {unit: …, start: 0} among the variables",
        ),
        (
            "hold(K*y*initial(time)/T)",
            "sample(a.x)",
            "E505 time inside initial wants a variable. "
            "Write: y1 = time, and y1: {unit: …, start: 0} among the variables",
        ),
        (
            "hold(K*sample(a.x))",
            "sample(a.x)",
            "E504 Own samples, and has clocks clock, slow. Write: sample(a.x, clock)",
        ),
        (
            "hold(K*sample(a.x, late))",
            "sample(a.x)",
            "E504 the second argument of sample wants a parameter of this component that is a clock, "
            "got late.",
        ),
        (
            "hold(K*y)",
            "2*sample(a.x) - mean(others.sent)",
            "E505 sent is sent at ticks of the link, and others.sent is heard at those of the clock. Write: "
            "sent1 = 2*sample(a.x) - mean(others.sent) among the equations, "
            "and sends: {sent: sample(hold(sent1))}",
        ),
    ],
)
def test_what_has_no_meaning_is_told(force: str, sent: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(ApcError) as error:
        scene(tmp_path, force, sent, clocked="y", start="0 m", continuous="a.x")
    assert any(told in str(mistake) for mistake in error.value.mistakes), str(error.value)


@pytest.mark.parametrize(
    ("equation", "told"),
    [
        ("w = K*y + L*w", "E401 L*w wants N like w, got N*m."),
        ("w = u + K*L\n  - u = w + L", "E401 u wants N like w, got m."),
    ],
)
def test_an_undeclared_variable_that_hangs_on_itself_has_a_unit(
    equation: str, told: str, tmp_path: Path
) -> None:
    with pytest.raises(ApcError) as error:
        scene(tmp_path, "hold(w)", "sample(a.x)", clocked="y", start="0 m", continuous=f"a.x\n  - {equation}")
    assert told in str(error.value)


def test_the_line_to_write_for_a_reduction_that_is_sent_works(tmp_path: Path) -> None:
    """What is heard and sent on, over a variable of the clock: each packet holds the newest of them."""
    text = OWN.format(
        force="hold(K*(y - relayed))",
        sent="sample(hold(relayed))",
        clocked="y",
        start="0 m",
        continuous="a.x",
    )
    (tmp_path / "parts").mkdir()
    relayed = "  - relayed = 0.5*sample(a.x, clock) + 0.5*mean(others.sent)\n"
    (tmp_path / "parts" / "own.yaml").write_text(text + relayed, encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(SCENE, encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    check_frame(system)
    assert 0.9 < analyze(system).spectral_radius < 1.1
