"""The methods of analysis by name: the single list of them.

Takes: nothing. Gives: `Method`, `METHODS`, `AUTO`, `PAPER`.
Guarantees: the command line, the Python function and the benchmark use this list.
Does not: implement a method (see `method_selection`, `paper_method`), or load anything.
"""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["auto", "modes", "dense", "determinant", "paper"]
METHODS: tuple[Method, ...] = get_args(Method)

AUTO: Method = "auto"  # the one that suits the model
PAPER: Method = "paper"  # has an implementation of its own
