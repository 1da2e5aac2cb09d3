"""`still`: how a scene begins, drawn from its equations alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from apc.compiler.compiled import CompiledSystem
from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.frame.start import start_values
from apc.present.still import Body, Wall, bodies_of, draw_still, save_still
from tests.topologies import AVERAGE, SCENES, compiled, replaced

pytest.importorskip("matplotlib")


def scene(name: str) -> CompiledSystem:
    return compiled((SCENES / f"{name}.yaml").read_text(encoding="utf-8").partition("\n")[2])


def first_peer(system: CompiledSystem, group: int = 0) -> tuple[list[Body], list[Wall]]:
    kind = system.kinds[system.groups[group].kind]
    vector = [float(one) for one in resolve(system).parameters[group][0]]
    return bodies_of(kind, vector, start_values(jacobians(kind), vector)[0])


def test_the_shared_body_has_the_width_at_which_it_is_touched() -> None:
    system = scene("experiment-average")
    assert first_peer(system) == ([Body("device", 0.03, 0.0), Body("cube", 0.0, 0.02)], [])
    assert first_peer(system, 1) == ([Body("device", -0.03, 0.0), Body("cube", 0.0, 0.02)], [])


def test_a_fixed_place_that_decides_is_a_wall() -> None:
    bodies, walls = first_peer(scene("finger"))
    assert [one.name for one in bodies] == ["device", "finger.bone"]
    assert walls == [Wall(0.0)]


def test_a_limit_of_a_force_is_no_surface() -> None:
    text = replaced(
        AVERAGE,
        ("type: SampledSpringDamper", "type: ForceSaturation"),
        ("stiffness: 1000 N/m,", "stiffness: 1000 N/m, limit: 3 N,"),
    )
    bodies, walls = first_peer(compiled(text))
    assert [one.half_width for one in bodies] == [0, 0]
    assert walls == []


def test_every_peer_has_a_row_and_the_rest_is_counted(tmp_path: Path) -> None:
    drawn = draw_still(scene("experiment-average")).axes[0]
    assert [one.get_text() for one in drawn.get_yticklabels()] == ["right[1]", "left[1]", "left[2]"]
    assert len(drawn.patches) == 3
    many = draw_still(compiled(replaced(AVERAGE, ("count: 3", "count: 1000")))).axes[0]
    assert many.get_title() == "three-users-average: at the start (988 more peers)"
    save_still(scene("experiment-average"), tmp_path / "still.svg")
    assert (tmp_path / "still.svg").read_text(encoding="utf-8").startswith("<?xml")
