"""Every scene by every method: refused in words, or true within the bound that is printed.

The truths are computed event by event in ball arithmetic (`fifty_digits.truth`); nothing of an analysis takes
part in them. Those of tests/hard are stored with the script that made them.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import flint
import pytest

from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from tests.fifty_digits.truth import Truth, spectral_truth
from tests.topologies import ROOT

STORED = json.loads((ROOT / "tests" / "hard" / "truths.json").read_text(encoding="utf-8"))
HARD = sorted((ROOT / "tests" / "hard").glob("*.yaml"))
OTHERS = sorted((ROOT / "models" / "scenes").glob("*.yaml")) + sorted(
    (ROOT / "tests" / "scenes").glob("*.yaml")
)

# What a method may say it can't serve, and why.
REFUSED = {
    "krylov": {
        "experiment-average": "not linear",
        "experiment-mesh": "not linear",
        "finger": "not linear",
        "hole": "no peer hears another",
        "island": "no peer hears another",
        "million-peers": "nothing is sparse",
        "stiff-wall-passivity": "not linear",
        "three-large-groups": "nothing is sparse",
        "two-users-dead-reckoning": "not linear",
        "two-users-proxies": "not linear",
    },
    "determinant": {
        "non-commensurate": "hides the peers' own eigenvalues",
    },
}

# Linearizations of which no truth is to be had event by event, and why; `test_schemes_in_time` has them.
UNTOLD = {
    "god-object": "hold functions whose values are rounded",
    "limited-motor": "is not linear",
    "three-users-scheduled": "looks at each sender by itself",
    "two-users-passivity": "not linear in what it hears",
    "two-users-set-position": "hold functions whose values are rounded",
}

# Bounds of the determinant that are wide all the same: of what their ticks round in a frame, of eigenvalues
# that are one (to the root of a rounding), of sites whose poles nearly cancel, of nothing left but the rigid.
WIDE = {
    "chain-of-masses": 1e-2,
    "coasting": 1.0,
    "defective": 1e-2,
    "nearly-defective": 1e-2,
    "ninety-hertz": 1e-2,
    "planar-users": 1e3,
    "stiff-contact": 1e-9,
}

# Bounds of Arnoldi's method likewise; where every motion drifts it has nothing to tell a radius by; a
# frame of a thousand ticks sums as many roundings.
WIDE_KRYLOV = {"client-server": 1.0, "coasting": 1.0, "defective": 1e-3, "high-rate-ratio": 1e-5}

# Where a server adds up what it is told, Arnoldi's method does not see which motion stands still and says so:
# it is among the modes, and its radius 1 bounds nothing.
STANDING = {("krylov", "client-server")}

# What other scenes' bounds are within, relative to a radius above 1: a verdict needs hardly more.
USEFUL = 1e-6

# Packets of a thousand frames, or a hundred in a frame, are as many states or rows of a sparse matrix: they
# take seconds, for what no sparse matrix is good for.
SLOW = {"very-long-delay", "non-commensurate"}


@cache
def _compiled(path: Path) -> CompiledSystem:
    return compile_topology(path)


@cache
def _truth(path: Path) -> tuple[flint.arb, int, str | None] | None:
    """Return the radius, how many motions are rigid, and the verdict where it is stored; None of `UNTOLD`."""
    if path.stem in STORED:
        stored = STORED[path.stem]
        return flint.arb(stored["spectral_radius"]), stored["rigid_modes"], stored["verdict"]
    found = spectral_truth(_compiled(path))
    if path.stem in UNTOLD:
        assert UNTOLD[path.stem] in str(found)
        return None
    assert isinstance(found, Truth), found
    return found.radius, found.rigid, None


def _check(path: Path, method: str, useful: float) -> None:
    truth = _truth(path)
    if truth is None:
        return
    radius, rigid, verdict = truth
    try:
        found = analyze(_compiled(path), method=method)
    except ApcError as error:
        [mistake] = error.mistakes
        assert mistake.code == "E850"
        assert REFUSED.get(method, {})[path.stem] in mistake.what
        return
    assert path.stem not in REFUSED.get(method, {})
    apart = abs(float((flint.arb(found.spectral_radius) - radius).mid()))
    assert apart <= found.spectral_radius_error
    assert found.spectral_radius_error <= useful * max(1.0, found.spectral_radius)
    if (method, path.stem) in STANDING:
        assert (found.stable, found.rigid_modes) == (None, 0)
        assert any("a motion that stands still" in text for text in found.notes)
        return
    assert found.rigid_modes == rigid
    if found.stable is not None:
        assert found.stable == (radius < 1 and verdict != "drifts")
        assert verdict is None or found.verdict == verdict


@pytest.mark.parametrize("path", HARD + OTHERS, ids=lambda path: path.stem)
def test_the_determinant_is_true_within_its_bound_or_refuses(path: Path) -> None:
    _check(path, "determinant", WIDE.get(path.stem, USEFUL))


@pytest.mark.parametrize(
    "path", [one for one in HARD + OTHERS if one.stem not in SLOW], ids=lambda path: path.stem
)
def test_krylov_is_true_within_its_bound_or_refuses(path: Path) -> None:
    _check(path, "krylov", WIDE_KRYLOV.get(path.stem, USEFUL))


@pytest.mark.parametrize("method", ["modes", "dense"])
@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.stem)
def test_small_matrices_and_one_large_are_true_within_their_bounds(path: Path, method: str) -> None:
    _check(path, method, USEFUL)
