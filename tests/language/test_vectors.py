"""Vectors are written out entry by entry as they are defined: what they come to is what NumPy says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.library.parts import rates
from tests.topologies import compiled, library, messages_of

OWN = """\
component: Own
connectors: {{flange: {prefix}Flange}}
parameters:
  F: {{unit: N, default: 1}}
  L: {{unit: m, default: 1}}
  T: {{unit: s, default: 1}}
  v: {{unit: 1, size: {size}, default: {v}}}
equations:
  - u = flange.x/L
  - flange.f = -F*({text})
"""
Vector = NDArray[np.float64]


def topology(size: int) -> str:
    peer_type = {2: "Planar", 3: "Spatial"}[size]
    return (
        f"topology: vectors\nclocks: {{tick: 1 ms}}\npeers: {{user: {{count: 1}}}}\n"
        f"masses: {{device: {{type: {peer_type}Mass, mass: 1 kg}}}}\n"
        "hands: {own: {type: Own, flange: device}}\n"
    )


def component(text: str, v: list[float]) -> str:
    prefix = {2: "Planar", 3: "Spatial"}[len(v)]
    return OWN.format(prefix=prefix, size=len(v), v=v, text=text)


def value(text: str, u: Vector, v: Vector, folder: Path) -> list[float]:
    """Return what a vector of u, where a mass is, and of v, a parameter, comes to: the force on 1 kg."""
    model = compiled(topology(len(u)), library(folder, component(text, v.tolist())))
    at = {f"device.x[{k + 1}]": float(one) for k, one in enumerate(u)}
    at |= {f"device.v[{k + 1}]": float(one) for k, one in enumerate(2 * u)}
    found = rates(model, at)
    return [found[f"device.v[{k + 1}]"] for k in range(len(u))]


# What a vector of u and v is written as, and what NumPy makes of it; der(u) is 2 u.
WRITTEN: dict[str, Callable[[Vector, Vector], Vector]] = {
    "u - 2*v": lambda u, v: u - 2 * v,
    "T*der(u)": lambda u, v: 2 * u,
    "dot(u, v)*u/3 - (v - u)*u[2]": lambda u, v: (u @ v) * u / 3 - (v - u) * u[1],
    "(if dot(u, v) > 1 then u else -v)": lambda u, v: u if u @ v > 1 else -v,
    "(if norm(u - v) > 1 then T*der(u - v) else -(u - v))": lambda u, v: (
        2 * u if np.linalg.norm(u - v) > 1 else v - u
    ),
    "max(u, v)/3 - max(v, -u)": lambda u, v: np.maximum(u, v) / 3 - np.maximum(v, -u),
    "norm(max(u, v))*(v - norm(v)*u)": lambda u, v: (
        np.linalg.norm(np.maximum(u, v)) * (v - np.linalg.norm(v) * u)
    ),
}
SPATIAL: dict[str, Callable[[Vector, Vector], Vector]] = {
    "{u[2], dot(u, v), norm(v)}": lambda u, v: np.array([u[1], u @ v, np.linalg.norm(v)]),
    "cross(u - v, {u[3], v[1], 0*u[1]})": lambda u, v: np.cross(u - v, [u[2], v[0], 0]),
    "dot(cross(u, v), u)*v - cross(v, cross(u, v))": lambda u, v: -np.cross(v, np.cross(u, v)),
}


@pytest.mark.parametrize(
    ("text", "size"),
    [*((text, size) for text in WRITTEN for size in (2, 3)), *((text, 3) for text in SPATIAL)],
)
def test_what_is_written_out_comes_to_what_numpy_says(text: str, size: int, tmp_path: Path) -> None:
    for seed in (1, 2):
        u, v = np.random.default_rng(seed).integers(-9, 10, (2, size)).astype(float)
        expected = (WRITTEN | SPATIAL)[text](u, v)
        (folder := tmp_path / str(seed)).mkdir()
        assert value(text, u, v, folder) == pytest.approx(expected, rel=1e-12, abs=1e-9), (u, v)


def test_what_doubles_at_each_level_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    nested = "cross(u, v)"
    for _ in range(30):
        nested = f"cross({nested}, v)"
    [line] = messages_of(compiled, topology(3), library(tmp_path, component(nested, [1.0, 2.0, 3.0])))
    assert (
        "the expression has more than 10000 terms, all entries included; give a subexpression a name" in line
    )
