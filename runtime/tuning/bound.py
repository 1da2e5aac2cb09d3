"""How much better gains could be than those that were found: none are by more than a share, proved.

Takes: scenes that limit the gains, the gains' ranges, and what was found.
Gives: `SHARE`, `none_better`.
Guarantees: all over each cell of the gains that would do better, an eigenvalue is proved to be outside the
circle in one of the scenes.
Does not: say that gains can do better where it proves nothing.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.analysis.box_proof import TOGETHER, open_questions
from apc.analysis.cells import Cell, ParametricClosedLoop, matrices_over
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.eigen.enclosure import least_radius
from apc.frame.instance import Prepared
from apc.frame.names import Range
from apc.frame.radius import value_of

# What nobody would tune further for; the most gains, and entries of the matrices of all cells: some seconds.
SHARE = Fraction(2, 100)
GAINS, ENTRIES = 3, 600_000


def none_better(
    scenes: Sequence[Model],
    prepared: Prepared,
    gains: Sequence[Range],
    aim: int,
    *,
    value: Fraction,
    larger: bool,
    inside: float,
    until: float,
) -> int | None:
    """Return in how many cells it is proved that no gains do better by `SHARE`; None where it is not.

    Parameters
    ----------
    scenes, prepared
        The scenes that limit the gains most, and what `instance.prepare` made of one.
    gains, aim
        The gains' ranges, and the place of that which is to be large, or small.
    value, larger
        What it is with the gains that were found; whether it is to be large.
    inside
        The radius of the circle that eigenvalues are wanted in.
    until
        When to give up, of `time.monotonic`.
    """
    beyond = value + (1 if larger else -1) * SHARE * abs(value)
    spans = [(gain.low, gain.high) for gain in gains]
    spans[aim] = (beyond, gains[aim].high) if larger else (gains[aim].low, beyond)
    if not spans[aim][0] < spans[aim][1] or len(gains) > GAINS:
        return None
    try:
        opened = [open_questions(scene, gains, prepared, inside) for scene in scenes]
    except ApcError:  # a scene that is no rational function of the gains
        return None
    questions = [question for item in opened for question in item.questions]
    cells: list[Cell] = [tuple(spans)]
    looked = entries = 0
    while cells:
        if not questions or entries > ENTRIES or time.monotonic() > until:
            return None
        some, cells = cells[:TOGETHER], cells[TOGETHER:]
        looked += len(some)
        unstable, widest, size = _looked(questions, some)
        entries += size
        for cell, place in ((some[index], int(widest[index])) for index in np.flatnonzero(~unstable)):
            low, high = cell[place]
            halves = ((low, (low + high) / 2), ((low + high) / 2, high))
            cells += [(*cell[:place], half, *cell[place + 1 :]) for half in halves]
    return looked


def _looked(
    questions: Sequence[ParametricClosedLoop], cells: Sequence[Cell]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], int]:
    """Return which cells are proved unstable, along which gain each varies most, and entries looked at."""
    unstable, size = np.zeros(len(cells), dtype=np.bool_), 0
    reach = np.zeros((len(cells), len(cells[0])))
    for question in questions:
        left = np.flatnonzero(~unstable)
        if not len(left):
            break
        matrix = matrices_over(question, [cells[place] for place in left.tolist()])
        size += matrix[:, 0].size
        reach[left] = np.maximum(reach[left], np.abs(matrix[:, 2:]).sum(axis=(2, 3)))
        outside = np.asarray(np.isfinite(matrix).all(axis=(1, 2, 3)))
        values = np.linalg.eigvals(value_of(matrix[outside]))
        outside[outside] = np.abs(values).max(axis=1, initial=0.0) > 1
        low = [least_radius(item[0], item[2:], item[1]) for item in matrix[outside]]
        unstable[left[outside]] = np.array(low) > 1
    return unstable, reach.argmax(axis=1), size
