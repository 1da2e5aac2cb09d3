"""Output of the paper's matrices.

Takes: a `PaperMethod` or `NamedMatrix`. Gives: its text.
Guarantees: every line fits 80 columns where its words allow it.
Does not: compute.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

from apc.output.formatting import (
    Lines,
)

if TYPE_CHECKING:
    from apc.extensions.paper_method.lifted_matrices import NamedMatrix, PaperMethod


def paper_method_text(paper_method: PaperMethod) -> Lines:
    """Yield the shapes of the paper's matrices, a line each."""
    yield f"ratio {paper_method.ratio}, frame {paper_method.frame_s * 1e3:.6g} ms"
    for field in fields(paper_method):
        matrix = getattr(paper_method, field.name)
        if hasattr(matrix, "columns"):
            which, mark, of = field.name.partition("_")
            name = "A_cl" if which == "closed" else f"{which.upper()}{mark}{of.replace('d', 'D')}"
            yield f"  {name:<6} {len(matrix.rows):>4} × {len(matrix.columns)}"


def matrix_text(named_matrix: NamedMatrix) -> Lines:
    """Yield the shape of a matrix and the ends of its names."""
    rows, columns = named_matrix.rows, named_matrix.columns
    ends = f": {rows[0]} … {rows[-1]} by {columns[0]} … {columns[-1]}" if named_matrix.values.size else ""
    yield f"{len(rows)} × {len(columns)}{ends}"
