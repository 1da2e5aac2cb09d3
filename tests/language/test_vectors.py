"""Vectors are written out entry by entry as they are defined: what they come to is what NumPy says."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.library.parts import rates
from tests.topologies import compiled, library, told

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


def scene(size: int) -> str:
    kind = {2: "Planar", 3: "Spatial"}[size]
    return (
        f"topology: vectors\nclocks: {{tick: 1 ms}}\npeers: {{user: {{count: 1}}}}\n"
        f"masses: {{device: {{type: {kind}Mass, mass: 1 kg}}}}\n"
        "hands: {own: {type: Own, flange: device}}\n"
    )


def component(text: str, v: list[float]) -> str:
    prefix = {2: "Planar", 3: "Spatial"}[len(v)]
    return OWN.format(prefix=prefix, size=len(v), v=v, text=text)


def value(text: str, u: Vector, v: Vector, folder: Path) -> list[float]:
    """Return what a vector of u, where a mass is, and of v, a parameter, comes to: the force on 1 kg."""
    system = compiled(scene(len(u)), library(folder, component(text, v.tolist())))
    at = {f"device.x[{k + 1}]": float(one) for k, one in enumerate(u)}
    at |= {f"device.v[{k + 1}]": float(one) for k, one in enumerate(2 * u)}
    found = rates(system, at)
    return [found[f"device.v[{k + 1}]"] for k in range(len(u))]


class _Made:
    """Random expressions of numbers and vectors, with what they come to by NumPy."""

    def __init__(self, seed: int) -> None:
        self.chance = chance = random.Random(seed)
        self.size = chance.choice((2, 3))
        self.u, self.v = (np.array([chance.randint(-9, 9) for _ in range(self.size)], float) for _ in "uv")

    def vector(self, depth: int) -> tuple[str, Vector]:
        pick = self.chance.randrange(9) if depth else 0
        if pick < 2:
            return self.chance.choice([("u", self.u), ("v", self.v)])
        if pick == 2:
            entries = [self.number(depth - 1) for _ in range(self.size)]
            return "{" + ", ".join(t for t, _ in entries) + "}", np.array([x for _, x in entries])
        one, two = self.vector(depth - 1), self.vector(depth - 1)
        if pick == 3:
            return f"({one[0]} - {two[0]})", one[1] - two[1]
        if pick == 4 and self.size == 3:
            return f"cross({one[0]}, {two[0]})", np.cross(one[1], two[1])
        if pick == 5:
            text, factor = self.number(depth - 1)
            return f"{text}*{one[0]}", factor * one[1]
        if pick == 6:
            text, left = self.number(depth - 1)
            return f"(if {text} > 1 then {one[0]} else -{two[0]})", one[1] if left > 1 else -two[1]
        if pick == 7:
            return "T*der(u)", 2 * self.u
        return f"max({one[0]}, {two[0]})/3", np.maximum(one[1], two[1]) / 3

    def number(self, depth: int) -> tuple[str, float]:
        if not depth or not self.chance.randrange(4):
            k = self.chance.randrange(1, self.size + 1)
            return f"u[{k}]", self.u[k - 1]
        one, two = self.vector(depth - 1), self.vector(depth - 1)
        if self.chance.randrange(2):
            return f"dot({one[0]}, {two[0]})", float(one[1] @ two[1])
        return f"norm({one[0]})", float(np.linalg.norm(one[1]))


@pytest.mark.parametrize("seed", range(40))
def test_what_is_written_out_comes_to_what_numpy_says(seed: int, tmp_path: Path) -> None:
    made = _Made(seed)
    text, expected = made.vector(4)
    found = value(f"'{text}'".strip("'"), made.u, made.v, tmp_path)
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-11 * (1 + np.abs(expected).max()))


def test_the_cross_of_two_vectors_of_a_plane_is_a_number(tmp_path: Path) -> None:
    u, v = np.array([2.0, -3.0]), np.array([5.0, 7.0])
    assert value("cross(u, v)*v", u, v, tmp_path) == [29 * 5, 29 * 7]


def test_what_doubles_at_each_level_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    nested = "cross(u, v)"
    for _ in range(30):
        nested = f"cross({nested}, v)"
    [line] = told(compiled, scene(3), library(tmp_path, component(nested, [1.0, 2.0, 3.0])))
    assert "entry by entry this has more than 10000 terms: give a part of it a name" in line
