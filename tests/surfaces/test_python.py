"""`apc`: plain functions with frozen results, the same as the commands."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import apc
from apc.support.arguments import _fits, _hints
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, messages_of, replaced

PATH = TOPOLOGIES / "three-users-average.yaml"


@pytest.fixture(scope="module")
def model() -> apc.Model:
    return apc.compile(PATH)


def test_every_public_name_is_there_and_nothing_else() -> None:
    assert set(apc.__all__) <= set(dir(apc))
    assert all(getattr(apc, name).__doc__ for name in apc.__all__)
    assert apc.__version__
    with pytest.raises(AttributeError, match="nothing"):
        apc.nothing  # noqa: B018 # looking it up is the test


def test_a_saved_model_analyses_as_the_one_it_was(model: apc.Model, tmp_path: Path) -> None:
    path = tmp_path / "topology.apc"
    apc.save(model, path)
    assert apc.analyze(apc.load(path)) == apc.analyze(model)
    assert apc.analyze(path) == apc.analyze(str(PATH)) == apc.analyze(model)


def test_setting_changes_a_copy_and_is_as_good_as_writing(model: apc.Model, tmp_path: Path) -> None:
    settings = {"coordination.stiffness": "5 N/mm", "lan.delay": "16 ms"}
    changed = apc.set_parameters(model, settings)
    for compiled_model, value in ((changed, 5000), (model, 500)):
        assert {p.name: p.value for p in compiled_model.parameters}["coordination.stiffness"] == value
    path = tmp_path / "topology.yaml"
    text = PATH.read_text(encoding="utf-8")
    path.write_text(replaced(text, ("500 N/m,", "5 N/mm,"), ("delay: 8 ms", "delay: 16 ms")), "utf-8")
    assert apc.analyze(changed) == apc.analyze(model, params=settings) == apc.analyze(path)
    assert apc.analyze(changed).verdict == "unstable"


def test_people_read_the_topology_s_own_units_and_programs_si(model: apc.Model) -> None:
    own = compiled(replaced(AVERAGE, ("500 N/m,", "0.5 N/mm,"), ("mass: 0.1 kg", "mass: 100 g")))
    stiffness, mass = "coordination.stiffness", "device.mass"
    axes = {"x": f"{stiffness}=0 N/m:2000 N/m", "y": f"{mass}=0.05 kg:0.2 kg"}
    for ask, printed in (
        (lambda topology: apc.critical(topology, stiffness), "below 1.09641 N/mm\n"),
        (lambda topology: apc.critical(topology, mass), "current value: 100 g\n"),
        (apc.parameters, "0.5 N/mm "),
        (lambda topology: apc.region(topology, **axes), f"{mass}             50 to 200 g"),
        (lambda topology: apc.robust_stability(topology, {mass: "±5%"}), f"{mass} from 95 g to 105 g"),
    ):
        assert printed in str(ask(own))
        plain, same = (json.dumps(ask(one).to_dict() | {"origin": None}) for one in (own, model))
        assert plain == same


def test_results_are_frozen_and_plain_data(model: apc.Model) -> None:
    result = apc.analyze(model)
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.verdict = "stable"  # type: ignore[misc] # that it can't be done is the test
    document = result.to_dict()
    assert set(document) >= {
        *("topology", "peers", "frame_s", "states_per_peer", "method", "verdict", "stable"),
        *("spectral_radius", "spectral_radius_error", "rigid_modes", "modes"),
    }
    assert sum(mode["multiplicity"] for mode in document["modes"]) == 3 * 8 - 1, "all but the translation"


def test_a_list_of_no_topologies_is_refused_and_one_topology_needs_no_list(model: apc.Model) -> None:
    assert messages_of(apc.compare, []) == [
        'compare: E610 no topology given. Try: apc.compare(["average.yaml", "mesh.yaml"])'
    ]
    assert messages_of(apc.report, []) == [
        'report: E610 no topology given. Try: apc.report(["average.yaml", "mesh.yaml"])'
    ]
    assert [scheme.topology for scheme in apc.compare(str(PATH)).schemes] == ["three-users-average"]
    assert messages_of(apc.robust_stability, model, {}) == [
        "box: E830 the box has no parameter. Try: device.damping=0 N*s/m:10 N*s/m"
    ]


def test_what_tells_of_texts_refuses_a_compiled_model(model: apc.Model) -> None:
    for function, given in ((apc.report, model), (apc.report, [model]), (apc.show, model)):
        [mistake] = messages_of(function, given)
        assert mistake.startswith("three-users-average.apc: E615 file is a compiled model")


FUNCTIONS = [name for name in apc.__all__ if inspect.isfunction(getattr(apc, name))]
GIVEN = {"values": {"contact.stiffness": [1.0]}, "parameter": "contact.stiffness", "hands": "held"}
GIVEN |= {"over": {"contact.stiffness": ["1 N/m"]}, "ranges": {"contact.stiffness": "±1%"}, "free": {}}
GIVEN |= {"frequencies": [1.0], "box": {"contact.stiffness": "±1%"}, "to": "json", "file": str(PATH)}
WRONG = [None, 7, ("contact.stiffness", "10 N/m", "3000 N/m"), {"a": 1}, [3], object(), b"x"]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_an_argument_of_a_wrong_type_is_said_to_be_one(
    name: str, model: apc.Model, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each argument of each function; what is of a right type, as None for an option, is left out."""
    monkeypatch.chdir(tmp_path)
    function = getattr(apc, name)
    parameters = inspect.signature(function).parameters
    needed = {
        one: GIVEN.get(one, model if one in ("model", "models") else str(PATH))
        for one, parameter in parameters.items()
        if parameter.default is inspect.Parameter.empty
    }
    for one in parameters:
        for wrong in WRONG:
            if _fits(wrong, _hints(inspect.unwrap(function))[one]):
                continue
            with pytest.raises((TypeError, apc.ApcError)) as raised:
                function(**{**needed, one: wrong})
            assert isinstance(raised.value, apc.ApcError) or f"apc.{name}: {one}: expected" in str(
                raised.value
            )


def test_a_number_in_si_is_the_quantity(model: apc.Model) -> None:
    name, other = "contact.stiffness", "coordination.stiffness"
    assert apc.analyze(model, params={"lan.delay": 0.016, "user.count": 4, name: np.float64(800)}) == (
        apc.analyze(model, params={"lan.delay": "16 ms", "user.count": "4", name: "800 N/m"})
    )
    assert apc.critical(model, other, upper=3000).value == apc.critical(model, other, upper="3 kN/m").value
    assert apc.robust_stability(model, {name: (900, 1100)}) == apc.robust_stability(
        model, {name: "900 N/m:1100 N/m"}
    )
    lists = apc.sweep(model, {name: [800, 900.0]}, jobs=1), apc.sweep(model, {name: "800,900 N/m"}, jobs=1)
    assert str(lists[0].to_dataframe()) == str(lists[1].to_dataframe())
    areas = [
        apc.region(model, x=x, y=(other, 10, 3000)).stable_area
        for x in ((name, 10, "3000 N/m"), f"{name}=10 N/m:3000 N/m")
    ]
    assert areas[0] == areas[1]
    assert len(apc.simulate(model, duration=0.1).values) == 101


def test_one_peer_is_struck(model: apc.Model) -> None:
    found = apc.simulate(model, impulse="user[2]")  # as fast as a list says, with a value a peer
    text = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.v: [0 m/s, 0.1 m/s, 0 m/s]}}"))
    assert np.array_equal(found.values, apc.simulate(compiled(text), duration="1 s").values)
    with pytest.raises(apc.ApcError, match=r'E983 unknown peer user\[4\]\. Try: --impulse "user\[1\]"'):
        apc.simulate(model, impulse="user[4]")


@pytest.mark.parametrize("wrong", [7, None, ("1 N/m", "2 N/m"), {"a": "b"}, [3]], ids=repr)
@pytest.mark.parametrize("call", ["set", "critical", "sweep", "analyze_many", "prove_box"])
def test_of_a_value_of_a_wrong_type_nothing_else_is_raised(
    call: str, wrong: object, model: apc.Model
) -> None:
    values: dict[str, Any] = {"contact.stiffness": wrong}
    calls: dict[str, Callable[[], object]] = {
        "set": lambda: apc.analyze(model, params=values),
        "critical": lambda: apc.critical(model, "contact.stiffness", lower="1 N/m", upper=cast(Any, wrong)),
        "sweep": lambda: apc.sweep(model, values),
        "analyze_many": lambda: apc.analyze_many(model, values),
        "prove_box": lambda: apc.robust_stability(model, values),
    }
    with contextlib.suppress(TypeError, apc.ApcError):  # a number in SI is a value of `analyze_many`
        calls[call]()
