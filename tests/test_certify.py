"""Claims about `apc.eigen.certify` and what `apc.eigen.spectrum` makes of it."""

from __future__ import annotations

import dataclasses
from typing import Any

import casadi
import flint
import numpy as np
import pytest

from apc.analysis.analysis import Analysis, analyze, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import precision
from apc.eigen.certify import prove, schur_cohn
from apc.eigen.modes import split
from apc.eigen.relative import independent_places
from apc.eigen.rigid import find_rigid_modes
from tests.sites import MS, alone, columned, grouped, linked, paper

TRANSLATING = "stable up to a common translation"


def _polynomial(*roots: complex) -> list[flint.arb]:
    """Return the coefficients of a real polynomial by its roots, lowest first."""
    exact = flint.acb_poly.from_roots([flint.acb(root.real, root.imag) for root in map(complex, roots)])
    return [coefficient.real for coefficient in exact.coeffs()]


@pytest.mark.parametrize(
    ("roots", "inside"),
    [
        ((0.5, -0.9, 0.3 + 0.4j, 0.3 - 0.4j), True),
        ((0.5, -1.25), False),
        ((0.5 + 0.875j, 0.5 - 0.875j, 0.0, 0.0, 0.0), False),  # |z|² = 1 + 2⁻⁶
        ((2.0, 0.125), False),  # their product is small: the second step shows it
        ((1 - 2.0**-50, 1 - 2.0**-49), True),
        ((1 + 2.0**-50, 0.5), False),
        ((1.0, 0.5), None),  # on the circle: nobody can tell
        ((0.5, 0.5, 0.5), True),
        ((), True),
    ],
)
def test_schur_and_cohn_tell_where_the_roots_are(roots: tuple[complex, ...], inside: bool | None) -> None:
    with precision(256):
        assert schur_cohn(_polynomial(*roots)) is inside


def test_random_polynomials_are_decided_as_their_roots_say() -> None:
    generator = np.random.default_rng(3)
    with precision(256):
        for _ in range(300):
            sizes = generator.uniform(0.8, 1.02, 3)
            angles = generator.uniform(0, np.pi, 3)
            pairs = [complex(r * np.cos(a), r * np.sin(a)) for r, a in zip(sizes, angles, strict=True)]
            roots = [*pairs, *(root.conjugate() for root in pairs), float(generator.uniform(-1.01, 1.01))]
            assert schur_cohn(_polynomial(*roots)) is (max(abs(root) for root in roots) < 1)


def _certified(system: CompiledSystem) -> Analysis:
    return analyze(system, certify=True)


@pytest.mark.parametrize(
    ("system", "verdict", "proof"),
    [
        (paper(), TRANSLATING, "proved stable with 256 bits"),
        (paper(kt=1200.0), "unstable", "proved unstable with 256 bits"),
        (paper(peers=1, operator="sum"), TRANSLATING, "proved stable with 256 bits"),
        (linked(paper(peers=8), "ring"), TRANSLATING, "proved stable with 256 bits"),  # cos 45° is irrational
        (linked(paper(peers=6), "star"), TRANSLATING, "proved stable with 256 bits"),
        (alone(), "stable", "proved stable with 256 bits"),
    ],
)
def test_a_verdict_that_floats_know_is_proved_when_asked_for(
    system: CompiledSystem, verdict: str, proof: str
) -> None:
    plain, certified = analyze(system), _certified(system)
    assert plain.proof == ""
    assert plain.verdict == certified.verdict == verdict
    assert certified.proof == proof
    assert abs(plain.spectral_radius - certified.spectral_radius) <= plain.spectral_radius_error
    assert certified.spectral_radius_error < 1e-15


def test_proved_modes_are_the_modes() -> None:
    for system in (paper(bt=2.0), linked(paper(peers=7), "ring")):
        plain, certified = analyze(system), _certified(system)
        for one in certified.modes:
            same = [mode for mode in plain.modes if mode.shape == one.shape]
            assert any(abs(mode.eigenvalue - one.eigenvalue) <= mode.error + one.error for mode in same)
            near = min(same, key=lambda mode: abs(mode.eigenvalue - one.eigenvalue))
            if one.magnitude > 0.1:
                assert near.frequency_hz == pytest.approx(one.frequency_hz, abs=1e-6)
                shares = zip(near.participation, one.participation, strict=True)
                assert max(abs(a[1] - b[1]) for a, b in shares) < 1e-6


def _undamped(**values: Any) -> CompiledSystem:
    system = paper(**values)
    return grouped(system, ("user", system.peers, {"device.damping": 0.0, "cube.damping": 0.0}))


def test_a_drift_is_told_from_a_translation_by_proof() -> None:
    found = _certified(_undamped(kt=0.0, bt=0.0, kc=0.0))
    assert found.verdict == "drifts"
    assert found.proof.startswith("proved to drift")
    assert found.rigid_modes == 6


def test_what_lies_on_the_circle_stays_undecided() -> None:
    """A mass on an undamped spring: its eigenvalues have magnitude one, exactly."""

    def swing(x: Any, u: Any) -> Any:
        return casadi.vertcat(x[1], -4 * x[0])

    system = alone()
    [kind] = system.kinds
    x, u, p, t = casadi.SX.sym("x", 2), casadi.SX.sym("u", 0), casadi.SX.sym("p", 1), casadi.SX.sym("t")
    states = (kind.states[0], dataclasses.replace(kind.states[0], name="v"))
    rate = casadi.Function("derivative", [x, u, p, t], [swing(x, u)])
    system = dataclasses.replace(system, kinds=(dataclasses.replace(kind, states=states, derivative=rate),))
    found = analyze(system)
    assert found.verdict == "undecided: |ρ−1| below the error bound"
    assert found.proof == "undecided at 4096 bits"
    assert abs(found.spectral_radius - 1) <= found.spectral_radius_error < 1e-15


def test_what_is_rounded_is_not_called_proved() -> None:
    found = _certified(alone(lambda x, u: -casadi.sin(x)))
    assert found.proof == ""
    assert found.notes == (
        "single: not proved, as the equations of peer hold functions whose values are rounded",
    )


def test_all_peers_as_one_system_are_proved_as_the_few_small_ones_are() -> None:
    for system in (paper(bt=2.0), columned(paper(), device__mass=[0.1, 0.2, 0.15])):
        whole, small = analyze(system, certify=True, method="dense"), _certified(system)
        assert whole.verdict == small.verdict == TRANSLATING
        assert whole.proof == small.proof == "proved stable with 256 bits"
        assert whole.spectral_radius == pytest.approx(small.spectral_radius, abs=1e-14)


def test_a_frame_of_thousand_ticks_is_decided() -> None:
    """1 ms and 7.99 ms: all clocks stand as before after 0.799 s; float bounds multiply up to 1e23."""
    found = analyze(paper(network=MS * 799 / 100, comm=8 * MS))
    assert found.verdict == TRANSLATING
    assert found.proof.startswith("proved stable with")
    assert found.spectral_radius_error < 1e-14


def test_more_bits_are_taken_as_long_as_they_decide() -> None:
    """At the last float below a boundary, 1 − ρ is 1e-16 or less: too near for floats, not for a proof."""
    low, high = 900.0, 1200.0
    while np.nextafter(low, high) < high:
        middle = (low + high) / 2
        low, high = (middle, high) if analyze(paper(kc=1000.0, kt=middle)).stable else (low, middle)
    below, above = (analyze(paper(kc=1000.0, kt=kt)) for kt in (low, high))
    assert (below.stable, above.stable) == (True, False)
    assert below.proof.startswith("decided with") or below.proof.startswith("proved stable")
    assert above.proof.startswith("proved unstable")
    assert abs(low - 1096.411) < 6e-4  # the reference limit of K_T at K_C = 1000


def test_equal_peers_in_a_chain_are_as_certain_as_one() -> None:
    """Each hears the one before, or all hear the first: equal eigenvalues, in Jordan blocks of five or not.

    Floats that take a block as one know it to the fifth root of a rounding.
    """
    system = paper("sum", peers=6, kt=50.0, kc=300.0)
    chain = _certified(linked(system, [(k, k + 1, 1.0) for k in range(5)]))
    population = _certified(linked(system, [(0, k, 1.0) for k in range(1, 6)]))
    assert chain.verdict == population.verdict
    assert chain.proof == population.proof == "proved stable with 256 bits"
    apart = abs(chain.spectral_radius - population.spectral_radius)
    assert apart <= chain.spectral_radius_error + population.spectral_radius_error < 1e-14


def test_what_balls_leave_open_stays_as_floats_decided_it() -> None:
    """Weights 2 and 1 around three peers: eigenvalues −1/2 ± i/6, of which floats know 14 digits."""
    arcs = [(1, 0, 2.0), (2, 0, 1.0), (0, 1, 1.0), (2, 1, 1.0), (1, 2, 1.0), (0, 2, 2.0)]
    system = linked(paper(kt=20.0, kc=0.5), arcs)
    plain, certified, whole = analyze(system), _certified(system), analyze(system, method="dense")
    assert plain.stable is certified.stable is whole.stable is True


def test_a_proof_names_where_the_discs_are() -> None:
    [common, difference] = split(*lifted_groups(paper())).systems
    for system in (common, difference):
        free = find_rigid_modes(system, with_drifts=False)
        proof = prove(system, free, independent_places(free.basis.T))
        assert proof.inside is True
        assert len(proof.values) == len(system.names) - len(free.names)
        assert (np.abs(proof.values) + proof.radii).max() < 1
