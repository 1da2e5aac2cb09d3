"""`pipeline`: a file goes through the stages in order, and each may be the last."""

from __future__ import annotations

import hashlib

import pytest

from apc.compiler.compiled import CompiledSystem
from apc.compiler.equations.clocks import ClockedSystem
from apc.compiler.equations.flatten import FlatSystem
from apc.compiler.equations.structure import SortedSystem
from apc.compiler.pipeline import STAGES, Stage, compile_topology, run_stages
from apc.compiler.scene.scene import Scene
from apc.compiler.source.source import Source
from tests.topologies import SCENES

PATH = SCENES / "three-users-average.yaml"
TYPES = (Source, Scene, FlatSystem, ClockedSystem, SortedSystem, CompiledSystem)


@pytest.mark.parametrize(("stage", "type_"), list(zip(STAGES, TYPES, strict=True)))
def test_each_stage_can_be_the_last(stage: Stage, type_: type) -> None:
    assert isinstance(run_stages(PATH, until=stage), type_)


def test_a_model_names_the_digest_of_every_text_it_was_made_from() -> None:
    origin = compile_topology(PATH).origin
    texts = dict(origin.digests)
    assert origin.topology == "three-users-average.yaml"
    assert set(texts) == {
        *("three-users-average.yaml", "AveragePosition", "Flange", "Link", "Mass", "SampledSpringDamper"),
        "apc",
    }
    assert texts["three-users-average.yaml"] == hashlib.sha256(PATH.read_bytes()).hexdigest()
    library = PATH.parents[1] / "mechanics" / "mass.yaml"
    assert texts["Mass"] == hashlib.sha256(library.read_bytes()).hexdigest()


def test_only_the_components_that_are_used_are_read() -> None:
    assert "FullMesh" not in dict(compile_topology(PATH).origin.texts)
