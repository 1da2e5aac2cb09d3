"""The topologies that come with the program: each compiles, and those of the paper get the paper's
verdicts.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from tests.topologies import TOPOLOGIES

COMMON = "stable up to a common translation"
# Verdict and rigid modes at the start values; what the paper has stands in its section IV and Fig. 6.
VERDICTS = {
    "carried-beam": (f"{COMMON} and rotation", 3),  # along both axes, and turned
    "finger": ("stable", 0),
    "lifted-box": ("stable", 0),
    "lossy-average": (COMMON, 1),
    "mixed-clocks": (COMMON, 1),
    "observer": (COMMON, 1),
    "sixty-hertz-user": (COMMON, 1),
    "teleoperation-pair": (COMMON, 1),
    "template": (COMMON, 1),
    "three-users-average": (COMMON, 1),
    "three-users-predicted": (COMMON, 1),
    "three-users-scheduled": (COMMON, 1),
    "three-users-mesh": (COMMON, 1),
    "two-rooms": (COMMON, 1),
    "two-handed-tool": (COMMON, 3),  # and at each user the hands apart from each other
    "two-users-damped": (COMMON, 1),
    "two-users-filtered-waves": (COMMON, 1),
    "two-users-reported": (COMMON, 1),  # what is summed up drifts nowhere
    "two-users-waves": (COMMON, 2),  # positions drift apart
    "unlike-devices": (COMMON, 1),
    "users-table": ("stable", 0),
}
NAMES = sorted(path.stem for path in TOPOLOGIES.glob("*.yaml"))


def path_of(name: str) -> Path:
    return TOPOLOGIES / f"{name}.yaml"


@pytest.mark.few(15)
@pytest.mark.parametrize("name", NAMES)
def test_every_topology_compiles_needs_all_it_names_and_has_its_verdict(name: str) -> None:
    model = apc.compile(path_of(name))
    assert model.description
    assert model.name == (name if name != "template" else "my-topology")
    assert model.dropped == ()
    if name in VERDICTS:
        result = apc.analyze(model)
        assert (result.verdict, result.rigid_modes) == VERDICTS[name]
