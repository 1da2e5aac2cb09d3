"""Who weighs whom by how much, as a sparse matrix of CasADi.

Takes: weights and their places. Gives: `weight_matrix`.
Guarantees: a product with it costs one multiplication an entry; weights of one place add up.
Does not: know whom the weights are of (see `gathering`).
"""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray


def weight_matrix(
    weights: NDArray[np.float64],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    shape: tuple[int, int],
) -> Any:
    """Return the casadi.DM of this shape with each weight (k,) at its row (k,) and column (k,)."""
    import scipy.sparse

    whole = scipy.sparse.coo_array((weights, (rows, columns)), shape=shape).tocsc()
    whole.sort_indices()  # CasADi wants the rows of a column in order
    return casadi.DM(whole)
