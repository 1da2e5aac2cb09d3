"""Some of the random scenes of `tests.bench.random_scenes`, which runs ten thousand."""

from __future__ import annotations

from dataclasses import replace

import flint
import pytest

from apc.analysis.analysis import analyze
from tests.bench.random_scenes import check, run
from tests.sites import paper


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [11, 14])
def test_no_bound_fails_and_no_verdict_is_wrong(seed: int) -> None:
    tally = run(8, seed=seed, draws=4)
    assert tally.wrong == []
    assert tally.scenes + tally.refused == 8
    assert tally.tightest <= 1


def test_what_is_wrong_is_seen() -> None:
    found = analyze(paper())
    radius = flint.arb(found.spectral_radius)
    assert check(found, radius, 1) == ""
    assert check(found, radius + 1e-9, 1).startswith("radius 0.957")
    assert check(replace(found, stable=False, verdict="unstable"), radius, 1).startswith("unstable, truth")
    assert check(found, radius, 2) == "1 rigid, truth 2"
