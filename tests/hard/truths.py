"""The truth about every topology here, to fifty digits: `python -m tests.hard.truths` writes truths.json.

All peers (equal ones by a representative and the weights of its class) are followed event by event in ball
arithmetic, see `tests.fifty_digits`; two precisions agree on every digit written. Nothing of the analysis
takes part.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from apc.compiler.compiled import Model
from apc.compiler.pipeline import compile_topology
from apc.spectrum.ball_arithmetic import precision
from tests.fifty_digits.truth import RIGID, Truth, classes_of, eigenvalues, frame_matrices, spectral_truth

HERE = Path(__file__).resolve().parent
TRUTHS = HERE / "truths.json"

# Below this a pivot of M − 1, of entries of 1 or more, is none: at 1024 bits its rounding is 1e-300.
NO_PIVOT = 1e-60

# Of a thousand frames of delay: its numbers stay, from the roots of det(z − P − z^(−d) Q S) in Arb's balls.
KEPT = "very-long-delay"


def main() -> None:
    """Write the truths."""
    found = json.loads(TRUTHS.read_text(encoding="utf-8"))
    for path in (path for path in sorted(HERE.glob("*.yaml")) if path.stem != KEPT):
        found[path.stem] = truth_of(compile_topology(path))
        print(
            f"{path.stem:<24} {found[path.stem]['spectral_radius'][:24]}  {found[path.stem]['verdict']}",
            flush=True,
        )
    TRUTHS.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def truth_of(model: Model) -> dict[str, Any]:
    """Return the radius (rigid modes left out), how many rigid modes there are, and the verdict."""
    truth = spectral_truth(model)
    assert isinstance(truth, Truth), truth
    chains = _chains(model)
    if truth.radius > 1:
        verdict = "unstable"
    elif chains:
        verdict = "drifts"
    else:
        verdict = "stable up to a common translation" if truth.rigid else "stable"
    return {"spectral_radius": truth.digits, "rigid_modes": truth.rigid - chains, "verdict": verdict}


def _chains(model: Model) -> int:
    """Return how many of the eigenvalues 1 have no vector of their own that stands still."""
    missing = 0
    with precision(1024):
        for _, count, matrix in frame_matrices(model, classes_of(model)):
            n = matrix.nrows()
            held = sum(float(abs(value - 1).mid()) < RIGID for value in eigenvalues(matrix))
            rows = [[matrix[i, j].mid() - (i == j) for j in range(n)] for i in range(n)]
            missing += count * (held - (n - _rank(rows)) if held else 0)
    return missing


def _rank(rows: list[list[Any]]) -> int:
    """Return the rank by Gaussian elimination with the largest pivot of all."""
    rank, places = 0, list(range(len(rows)))
    rows = [list(row) for row in rows]
    while places:
        size, r, c = max(
            ((float(abs(rows[r][c])), r, c) for r in range(rank, len(rows)) for c in places),
            key=lambda one: one[0],
        )
        if size < NO_PIVOT:
            break
        rows[rank], rows[r] = rows[r], rows[rank]
        for row in rows[rank + 1 :]:
            factor = row[c] / rows[rank][c]
            for place in places:
                row[place] = (row[place] - factor * rows[rank][place]).mid()
        places.remove(c)
        rank += 1
    return rank


if __name__ == "__main__":
    main()
