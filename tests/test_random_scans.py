"""Some of the random scans of `tests.bench.random_scans`, which runs hundreds."""

from __future__ import annotations

import random
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.vary.critical import critical
from tests.bench.random_scans import BUMP, check, draw, radii, run
from tests.bruteforce import Scene, frame_matrices, frame_matrix
from tests.topologies import compiled, library


@pytest.mark.parametrize("seed", [3, 4])
def test_no_crossing_is_invented_and_none_is_missed(seed: int) -> None:
    tally = run(4, seed=seed)
    assert tally.wrong == []
    assert tally.scans == 4


def test_what_is_wrong_is_seen(tmp_path) -> None:  # type: ignore[no-untyped-def] # pytest's own
    generator = random.Random(0)
    drawn = (draw(generator) for _ in range(100))
    scan = next(one for one in drawn if one.name == "coordination.stiffness" and one.scene.own_delay)
    system = compiled(scan.text, library(tmp_path, BUMP))
    assert radii(scan, np.array([scan.present]))[0] == pytest.approx(
        analyze(system).spectral_radius, abs=1e-9
    )
    found = critical(system, scan.name)
    assert found.crossings
    assert check(scan, found) == ""
    assert "is claimed at" in check(scan, replace(found, crossings=()))
    first = found.crossings[0]
    invented = replace(first, value=first.value / 3, stable_side="above")
    assert "is claimed at" in check(scan, replace(found, crossings=(invented, *found.crossings)))
    short = (0.0, scan.present / 2)
    assert "is not in what was scanned" in check(scan, replace(found, scanned=short))


def test_many_scenes_at_once_are_each_the_one_matrix() -> None:
    stiff = np.array([10.0, 500.0, 4000.0])
    scene = Scene(kt=stiff, own_delay=True, contact_comp=Fraction(13, 100_000), comm=Fraction(1, 300))  # type: ignore[arg-type] # an array
    found = frame_matrices(scene, 3)
    for one, matrix in zip(stiff, found, strict=True):
        assert matrix == pytest.approx(np.array(frame_matrix(replace(scene, kt=float(one)))), abs=1e-12)
