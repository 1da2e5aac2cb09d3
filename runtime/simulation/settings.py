"""How a scene is played: for how long, by which method, with what luck.

Takes: what a command line or a call says. Gives: `Settings`.
Guarantees: two runs of one scene with equal settings are the same run.
Does not: say what is recorded (see `signals`).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from apc.simulation.methods import DEFAULT, Method


@dataclass(frozen=True, slots=True)
class Settings:
    """How a scene is played.

    `duration` is in seconds, the last row that of the last tick until then; `method` says how the continuous
    states move between events; `seed` is of what is random, None for the experiment's own; `jit` says whether
    to compile to machine code where there is a C compiler.
    """

    duration: Fraction
    method: Method = DEFAULT
    seed: int | None = None
    jit: bool = True
