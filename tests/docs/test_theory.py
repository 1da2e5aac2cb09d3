"""The worked examples of the theory pages: their code runs, and their numbers are true.

Each page's numbers are compared with its code's output, then with a closed form or with a small matrix that
NumPy builds here, without the program.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import brentq

from tests.surfaces.test_readme import NUMBER, last_digit
from tests.topologies import ROOT

Matrix = NDArray[np.float64]

PAGES = sorted(page for page in (ROOT / "docs" / "theory").glob("*.md") if page.stem != "index")
NAMES = [page.stem for page in PAGES]
BLOCK = re.compile(r"^```(python|text)\n(.*?)^```", re.DOTALL | re.MULTILINE)
MASS, DAMPING, PERIOD = 0.1, 5.0, 1e-3  # the device and its clock, in every example


def blocks(name: str) -> tuple[list[str], str]:
    """Return the code of a page, and the output shown after it."""
    found = BLOCK.findall((ROOT / "docs" / "theory" / f"{name}.md").read_text(encoding="utf-8"))
    return [text for kind, text in found if kind == "python"], "".join(
        text for kind, text in found if kind == "text"
    )


@cache
def printed(name: str) -> str:
    """Return the output of a page's code, run from the root of the repository."""
    code, _ = blocks(name)
    out = io.StringIO()
    with contextlib.chdir(ROOT), contextlib.redirect_stdout(out):
        exec(compile("\n".join(code), f"{name}.md", "exec"), {})  # our own text
    return out.getvalue()


def line(name: str, start: str) -> list[float]:
    """Return the numbers behind the given start of a line of a page's output."""
    (found,) = [row for row in printed(name).splitlines() if row.startswith(start)]
    return [float(number) for number in NUMBER.findall(found.removeprefix(start))]


def test_the_pages_are_listed_and_have_an_example() -> None:
    index = (ROOT / "docs" / "theory" / "index.md").read_text(encoding="utf-8")
    listed = re.findall(r"^[a-z-]+$", index.partition("```{toctree}")[2].partition("```")[0], re.MULTILINE)
    assert sorted(listed) == NAMES
    assert len(NAMES) == 10
    for name in NAMES:
        code, shown = blocks(name)
        assert code, name
        assert NUMBER.findall(shown), name


def test_every_citation_has_a_source() -> None:
    sources = re.findall(
        r"^@\w+{(\w+),", (ROOT / "docs" / "sources.bib").read_text(encoding="utf-8"), re.MULTILINE
    )
    cited = {key for page in PAGES for key in re.findall(r"{cite}`(\w+)`", page.read_text(encoding="utf-8"))}
    assert len(set(sources)) == len(sources)
    assert cited
    assert cited <= {*sources}


@pytest.mark.needs_extension("loss_models", "paper_method", "system_norms")
@pytest.mark.parametrize("name", NAMES)
def test_the_numbers_shown_are_printed(name: str) -> None:
    """But for the last digit, and an error by half of itself, as on the other pages."""
    _, shown = blocks(name)
    out = printed(name)
    assert re.sub(r"[\s\d.]+|e-", " ", out) == re.sub(r"[\s\d.]+|e-", " ", shown)
    for one, other in zip(NUMBER.findall(out), NUMBER.findall(shown), strict=True):
        room = max(map(last_digit, (one, other))) if "e" not in one else max(map(Fraction, (one, other))) / 2
        assert abs(Fraction(one) - Fraction(other)) <= room, (one, other)


# ---- small systems, by NumPy alone ----


def step(stiffness: float, damping: float = DAMPING, period: float = PERIOD) -> tuple[Matrix, Matrix]:
    """Return the map (2, 2) of a device on one sampled spring, and the effect (2,) of a held force."""
    both = expm(np.array([[0, 1, 0], [0, -damping / MASS, 1 / MASS], [0, 0, 0]]) * period)
    free, force = both[:2, :2], both[:2, 2]
    return free - np.outer(force, [stiffness, 0.0]), force


def users(
    weights: Matrix,
    contact: float,
    stiffness: float,
    damping: float = 0.0,
    copy: float = 0.2,
    late: int = 8,
) -> Matrix:
    """Return the frame's map of the paper's peers: a device, a copy, both forces late by one tick of eight.

    A peer has (x, v) of device and copy, two held forces, the sample received, and those of the last two
    packets, each (x, v). Packets take `late` ticks, 8 to 15.
    """
    rates = np.zeros((6, 6))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, [1, 4]] = -DAMPING / MASS, -1 / MASS
    rates[3, [3, 4, 5]] = -DAMPING / copy, 1 / copy, -1 / copy
    transition = expm(rates * PERIOD)
    number = len(weights)
    every = np.eye(number)

    own, others = np.eye(12), np.zeros((12, 12))
    own[:4] = 0.0
    own[:4, :6] = transition[:4]
    own[4:6] = 0.0
    own[4, [0, 2]] = contact, -contact
    own[5, [2, 3]] = stiffness, damping
    others[5, 6:8] = -stiffness, -damping
    tick = np.kron(every, own) + np.kron(weights, others)

    # At the frame's start (8, 9) is the sample of the last frame's start, (10, 11) that of the one before.
    newest, oldest, packets = np.eye(12), np.eye(12), np.zeros((12, 12))
    newest[[6, 7]] = np.eye(12)[[8, 9]]
    oldest[[6, 7]] = np.eye(12)[[10, 11]]
    frame = np.eye(12 * number)
    for index in range(8):
        frame = tick @ np.kron(every, newest if index >= late - 8 else oldest) @ frame
    packets[[8, 9], [2, 3]] = packets[[10, 11], [8, 9]] = 1.0
    return np.kron(every, np.diag([1.0] * 8 + [0.0] * 4)) @ frame + np.kron(every, packets)


def complete(number: int) -> Matrix:
    """Return the weights of the mean of the others."""
    return (np.ones((number, number)) - np.eye(number)) / (number - 1)


def magnitudes(matrix: Matrix) -> Matrix:
    """Return the eigenvalues' magnitudes, the largest first."""
    return np.sort(np.abs(np.linalg.eigvals(matrix)))[::-1]


def relative(matrices: list[Matrix], rigid: Matrix) -> list[Matrix]:
    """Return maps without their common rigid mode."""
    for matrix in matrices:
        assert np.abs(matrix @ rigid - rigid).max() < 1e-12
    rest = np.linalg.svd(rigid[None])[2][1:]
    return [rest @ matrix @ rest.T for matrix in matrices]


# ---- one claim a page ----


def relayed(delay: float) -> float:
    """Return the spectral radius of x″ = 126.7 u, u = −50 x − 11.8 x′ of samples every 1 ms, late by a delay.

    The states are x, x′ and the controls of the last two samples.
    """
    rates = np.zeros((3, 3))
    rates[0, 1], rates[1, 2] = 1.0, 126.7
    late = round(delay // PERIOD)
    old, new = expm(rates * (delay - late * PERIOD)), expm(rates * (PERIOD - delay + late * PERIOD))
    gain = np.array([-50, -11.8])
    step = np.zeros((4, 4))
    for column, (x, v, last, before) in enumerate(np.eye(4)):
        present = float(gain @ [x, v])
        acting = [present, last, before][late : late + 2][::-1]
        moved = new @ [*(old @ [x, v, acting[0]])[:2], acting[1]]
        step[:, column] = *moved[:2], present, last
    return float(abs(np.linalg.eigvals(step)).max())


def test_time_semantics() -> None:
    """Packets of 8 ms act at the first tick; the hyperperiod is that of two rationals."""
    for name, late in (("delay 8 ms", 8), ("delay 8.5 ms", 9), ("delay 9 ms", 9)):
        (radius,) = line("time-semantics", f"{name}: ")
        assert magnitudes(users(complete(3), 1000.0, 500.0, late=late))[1] == pytest.approx(radius, abs=1e-9)
    for name, delay in (("order after", 0.2e-3), ("order before", 1.2e-3)):
        (radius,) = line("time-semantics", f"{name}: ")
        assert relayed(delay) == pytest.approx(radius, abs=1e-9)
    (frame,) = line("time-semantics", "frame of 1 ms and 1/90 s: ")
    assert Fraction(frame).limit_denominator(1000) == Fraction(math.lcm(1, 1), math.gcd(1000, 90))


@pytest.mark.needs_extension("paper_method")
def test_lifting() -> None:
    """The product of the frame's two intervals has the eigenvalue shown."""
    first, force = step(1500.0)
    second, _ = step(1000.0)
    frame = second @ first - np.outer(force, [500.0, 0.0])
    eigenvalue = max(np.linalg.eigvals(frame), key=lambda value: value.imag)
    real, imaginary = line("lifting", "eigenvalue ")
    assert eigenvalue == pytest.approx(complex(real, imaginary), abs=1e-9)
    radius, milliseconds = line("lifting", "spectral radius ")
    assert abs(eigenvalue) == pytest.approx(radius, abs=1e-9)
    assert milliseconds == 2


def test_decomposition() -> None:
    """The matrix of all peers has the modes' eigenvalues; a mesh is an average of N - 1 times its gain."""
    dense = magnitudes(users(complete(3), 1000.0, 500.0))
    assert dense[0] == pytest.approx(1.0, abs=1e-9)  # rigid
    for method in ("modes", "dense"):
        assert dense[1] == pytest.approx(line("decomposition", f"{method}: ")[0], abs=1e-9)
    for number in (2, 3, 5):
        (average,) = line("decomposition", f"N = {number}, average: ")
        (mesh,) = line("decomposition", f"N = {number}, mesh: ")
        assert mesh == pytest.approx(average / (number - 1), abs=1e-3)
        at_limit = magnitudes(users(complete(number), 1000.0, (number - 1) * mesh, copy=0.6 / number))
        assert at_limit[1] == pytest.approx(1.0, abs=1e-6)
    neighbours = np.roll(np.eye(8), 1, axis=0) + np.roll(np.eye(8), -1, axis=0)
    ring = magnitudes(users(neighbours / 2, 1000.0, 300.0, damping=1.0, copy=0.1))
    for family in ("-2", "-1.41421", "+0"):
        magnitude, multiplicity = line("decomposition", f"ring, graph {family}: ")
        assert np.sum(np.abs(ring - magnitude) < 1e-8) == 2 * multiplicity  # a conjugate pair


def _pair(contact: float, device: float, cube: float) -> Matrix:
    """Return the map of device and cube (x, v, x, v) on a sampled spring and damper of 2 N·s/m."""
    rates = np.zeros((5, 5))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, [1, 4]] = -device / MASS, -1 / MASS
    rates[3, [3, 4]] = -cube / 0.6, 1 / 0.6
    both = expm(rates * PERIOD)
    held = np.outer(both[:4, 4], [contact, 2.0, -contact, -2.0])
    return np.asarray(both[:4, :4] + held)


def test_rigid_modes() -> None:
    """The known directions solve the frame's equations; the rest has the radius shown."""
    position, velocity = np.array([1.0, 0.0, 1.0, 0.0]), np.array([0.0, 1.0, 0.0, 1.0])
    for name, matrix, rigid, neutral in (
        ("damped", _pair(1000.0, 5.0, 5.0), 1, 1),
        ("without friction", _pair(1000.0, 0.0, 0.0), 1, 2),
        ("without spring", _pair(0.0, 5.0, 5.0), 2, 2),
    ):
        assert np.abs(matrix @ position - position).max() < 1e-14
        count, radius = line("rigid-modes", f"{name}: ")
        assert count == rigid
        assert np.abs(magnitudes(matrix)[:neutral] - 1).max() < 1e-6
        assert magnitudes(matrix)[neutral] == pytest.approx(radius, abs=1e-9)
    drifting = _pair(1000.0, 0.0, 0.0)
    assert np.abs(drifting @ velocity - velocity - PERIOD * position).max() < 1e-14
    one, other = np.array([1.0, 0, 0, 0]), np.array([0, 0, 1.0, 0])
    for alone in (one, other):
        assert np.abs(_pair(0.0, 5.0, 5.0) @ alone - alone).max() < 1e-14
    assert "without friction: drifts" in printed("rigid-modes")


def test_error_bounds() -> None:
    """The interval contains exp(-1/20); the critical value is that of NumPy's eigenvalues."""
    shown = re.match(r"(\S+), error (\S+),", printed("error-bounds"))
    assert shown
    with localcontext() as context:
        context.prec = 50
        error = abs(Decimal(shown[1]) - (Decimal(-1) / 20).exp())
        assert error <= Decimal(shown[2]) + Decimal("0.5e-15")  # and the rounding to 15 digits
    value, bound, _bits = line("error-bounds", "critical stiffness ")
    rigid = np.tile([1.0, 0, 1, 0, 0, 0, 1, 0, 1, 0, 1, 0], 3)

    def excess_at(stiffness: float) -> float:
        (rest,) = relative([users(complete(3), 1000.0, stiffness)], rigid)
        return float(magnitudes(rest)[0]) - 1

    crossing = brentq(excess_at, 1000.0, 1200.0)
    assert value == pytest.approx(crossing, abs=1e-4)
    assert 0 < bound < 1e-6
    excess = line("error-bounds", "at 1096.410868365647 N/m: ")[0]
    assert 0 < excess < 1e-15


def _coupled(lost: tuple[int, int], ticks: int, stiffness: float = 200.0) -> tuple[Matrix, Matrix]:
    """Return the frame's map of two coupled devices, and the effect of a force of 1 N on the first.

    A peer has x, v, the packet in transit, and the value held; a packet takes one frame.
    """
    free, force = step(0.0)
    arrive, tick, push = np.zeros((8, 8)), np.zeros((8, 8)), np.zeros(8)
    for peer, other in ((0, 4), (4, 0)):
        arrive[peer, peer] = arrive[peer + 1, peer + 1] = arrive[peer + 2, peer] = 1.0
        arrive[peer + 3, peer + 3 if lost[peer // 4] else other + 2] = 1.0
        tick[peer : peer + 2, peer : peer + 2] = free
        tick[peer : peer + 2, peer] -= stiffness * force
        tick[peer : peer + 2, peer + 3] += stiffness * force
        tick[peer + 2, peer + 2] = tick[peer + 3, peer + 3] = 1.0
    frame = arrive
    for _ in range(ticks):
        frame, push = tick @ frame, tick @ push + np.concatenate([force, np.zeros(6)])
    return frame, push


@pytest.mark.needs_extension("loss_models")
def test_mean_square() -> None:
    """The sum of Kronecker products over all loss patterns has the growth shown; a scalar loop its limit."""
    patterns = [(0, 0), (0, 1), (1, 0), (1, 1)]
    maps = relative([_coupled(lost, 2)[0] for lost in patterns], np.tile([1.0, 0.0, 1.0, 1.0], 2))
    assert magnitudes(maps[0])[0] == pytest.approx(line("mean-square", "nominal radius ")[0], abs=1e-9)
    for loss in (0.1, 0.3, 0.6, 0.9):
        second = sum(
            loss ** sum(lost) * (1 - loss) ** (2 - sum(lost)) * np.kron(matrix, matrix)
            for lost, matrix in zip(patterns, maps, strict=True)
        )
        growth, root = line("mean-square", f"loss {loss}: ")
        assert magnitudes(np.asarray(second))[0] == pytest.approx(growth, abs=1e-8)
        assert math.sqrt(growth) == pytest.approx(root, abs=1e-8)
    limit = (1 - (1.1 - 1) ** 2) / (1.1**2 - (1.1 - 1) ** 2)
    assert limit == pytest.approx(0.825, abs=1e-12)


def test_passive_operators() -> None:
    """Colgate and Schenkel's damping, with delay, and with a wall's own; the clamped limit of the device."""
    stiffness, wall = 1000.0, 0.2
    for name, delay in (("delay 0 ms", 0.0), ("delay 1 ms", 1e-3)):
        (needed,) = line("passive-operators", f"{name}: ")
        assert needed == pytest.approx(stiffness * (PERIOD / 2 + delay), abs=1e-6)
    (needed,) = line("passive-operators", "wall damping 0.2 N*s/m: ")
    assert needed == pytest.approx(stiffness * PERIOD / 2 + wall, abs=1e-6)
    (passive,) = line("passive-operators", "largest stiffness, passive: ")
    assert passive == pytest.approx(2 * 1.0 / PERIOD, abs=1e-3)
    (free,) = line("passive-operators", "largest stiffness, nominal: ")
    assert magnitudes(step(free, damping=1.0)[0])[0] == pytest.approx(1.0, abs=1e-8)
    # the condition at each frequency, of a wall with a backward difference
    angle = np.linspace(1e-3, np.pi, 1000)
    back = 1 - np.exp(-1j * angle)
    bound = PERIOD / 2 * np.real(back * (stiffness + wall / PERIOD * back)) / (1 - np.cos(angle))
    assert bound.max() == pytest.approx(needed, abs=1e-6)


@pytest.mark.needs_extension("system_norms")
def test_transparency() -> None:
    """The terminal velocity under a constant force gives the damping, near the first-order value."""
    frame, push = _coupled((0, 0), 4)
    state = np.zeros(8)
    for _ in range(2000):
        state, before = frame @ state + push, state
    velocity = (state[0] - before[0]) / (4 * PERIOD)
    (damping,) = line("transparency", "damping at low frequency ")
    assert 1 / velocity == pytest.approx(damping, abs=2e-6)
    (network,) = line("transparency", "network damping ")
    assert network == pytest.approx(2 * 200.0 * ((4e-3 - PERIOD) / 2 + 4e-3), rel=1e-4)
    assert network == pytest.approx(1 / velocity - 2 * DAMPING, abs=2e-6)
    assert line("transparency", "0.1 Hz: ")[0] == pytest.approx(damping, rel=1e-4)


def _limit(damping: float) -> float:
    """Return the largest stable stiffness of a device on a sampled spring."""
    kept = math.exp(-damping * PERIOD / MASS)
    path = MASS * (1 - kept) / damping
    return (1 - kept) / (path * (1 - kept) / damping - kept * (PERIOD - path) / damping)


def test_regions() -> None:
    """The boundary and the area have the closed form of Jury's test."""
    for damping in (0.5, 5.0):
        (stiffness,) = line("regions", f"boundary at {damping} N*s/m: ")
        assert stiffness == pytest.approx(_limit(damping), abs=1e-3)
        assert magnitudes(step(stiffness, damping)[0])[0] == pytest.approx(1.0, abs=1e-7)
    (area, *_) = line("regions", "stable area ")
    assert area == pytest.approx(quad(_limit, 0.5, 5.0)[0], abs=1e-3)
    assert 2000.0 < _limit(1.0) < 2010.0
    assert "2000 N/m at 1 N*s/m stable: True" in printed("regions")
    assert "2010 N/m at 1 N*s/m stable: False" in printed("regions")


def test_simulation() -> None:
    """The recursion at the ticks has the positions shown, its eigenvalue the time constant and frequency."""
    matrix, force = step(500.0)
    state = np.zeros(2)
    for index in range(1, 1001):
        state = matrix @ state + 2.0 * force
        if index in (10, 50, 1000):
            (position,) = line("simulation", f"position at {index:4d} ms: ")
            assert 1e3 * state[0] == pytest.approx(position, abs=1e-8)
    exponent = np.log(np.linalg.eigvals(matrix).astype(complex)[0]) / PERIOD
    for name in ("simulated: ", "analyzed: "):
        constant, frequency = line("simulation", name)
        assert -1 / exponent.real == pytest.approx(constant, abs=1e-6)
        assert abs(exponent.imag) / (2 * math.pi) == pytest.approx(frequency, abs=1e-5)
