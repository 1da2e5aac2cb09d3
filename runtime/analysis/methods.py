"""The methods of analysis by name: the one list of them.

Takes: nothing. Gives: `Method`, `METHODS`, `AUTO`, `PAPER`.
Guarantees: what the command line offers, the Python function takes and the benchmark measures is one list.
Does not: know how a method works (see `plan`, `paper`), or load anything.
"""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["auto", "modes", "dense", "determinant", "paper"]
METHODS: tuple[Method, ...] = get_args(Method)

AUTO: Method = "auto"  # that which serves the scene
PAPER: Method = "paper"  # has a route of its own
