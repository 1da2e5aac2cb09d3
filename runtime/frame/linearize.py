"""The matrices of one site for its parameters, or of many sites at once.

Takes: a kind's `SiteJacobians`, a parameter vector or many, what the site hears at the start.
Gives: `linearize`, `linearize_exact`, `linearize_rows`; `site_of_row`, `sites_of_rows`, `site_of_entries`.
Guarantees: a site that is not affine is linearized at its start values.
Does not: decide when anything happens (see `scheduling`).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.runtime.frame.exact import evaluate_exact
from apc.runtime.frame.jacobians import SiteJacobians
from apc.runtime.frame.parameters import exact_numbers
from apc.runtime.frame.site import LinearSite, assemble, cut, matrices_of, with_own_parts
from apc.runtime.frame.start import Listening, start_arguments

# Parameter vectors evaluated by one call: of many more at once, CasADi's copies take longer than its work.
MAPPED = 1024


def linearize(
    site: SiteJacobians, parameters: NDArray[np.float64], listening: Listening | None = None
) -> LinearSite:
    """Return the matrices of a site, in floats.

    Parameters
    ----------
    site
        The kind's Jacobians.
    parameters
        The site's vector (n_p,), in the order of `Kind.parameters`.
    listening
        What the site hears at the start. Left out, the others stand where this site stands; a site with edge
        functions can't do without.
    """
    if listening is not None and site.edges:
        # A sum of slopes over many peers: rounded once, whatever cancels in it.
        exact = linearize_exact(site, parameters, listening)
        return assemble(
            site.kind, site.affine, [one.astype(np.float64) for one in matrices_of(exact)], _channels_of(site)
        )
    arguments = start_arguments(site, [float(value) for value in parameters], float, listening)
    flat = np.asarray(site.function(*arguments), dtype=np.float64).ravel()
    return site_of_row(site, flat)


def linearize_exact(
    site: SiteJacobians, parameters: NDArray[np.float64], listening: Listening | None = None
) -> LinearSite:
    """Return the same matrices as `linearize` in exact rationals, as object arrays of `Fraction`.

    Parameters
    ----------
    site, parameters, listening
        As for `linearize`.
    """
    assert listening is not None or not site.edges, "who is heard decides what an edge function does"
    assert site.function.is_a("SXFunction"), "the solution of a nonlinear loop is no rational number"
    arguments = start_arguments(site, exact_numbers(site.kind, parameters), Fraction, listening)
    flat = np.array(evaluate_exact(site.function, arguments)[0], dtype=object)
    exact = assemble(site.kind, site.affine, cut(flat, site.shapes), _channels_of(site))
    if listening is None:
        return exact
    rest = iter(listening.own)
    own = [
        [None if (part := next(rest)) is None else np.array(part, dtype=object) for _ in partition.receives]
        for partition in site.kind.clocks
    ]
    return with_own_parts(exact, own, np.add, np.multiply.outer)


def linearize_rows(site: SiteJacobians, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices of an affine site without edges for many parameter vectors (k, n_p), as rows.

    The rows (k, …) hold what `site_of_row` makes a site of.
    """
    assert site.parameters_suffice, "the start matters"
    zeros = [np.zeros(site.function.numel_in(argument)) for argument in range(4)]
    rows = np.empty((len(parameters), site.function.numel_out(0)))
    many = None
    for start in range(0, len(parameters), MAPPED):
        some = parameters[start : start + MAPPED]
        if many is None or len(some) != MAPPED:
            many = site.function.map(len(some))
        flats = many(*(np.repeat(zero[:, None], len(some), axis=1) for zero in zeros), some.T, 0.0)
        rows[start : start + MAPPED] = np.asarray(flats, dtype=np.float64).reshape(-1, len(some)).T
    return rows + 0.0  # −0 and 0 are one number


def sites_of_rows(site: SiteJacobians, rows: NDArray[np.float64]) -> LinearSite:
    """Return the sites of many rows (k, …) of `linearize_rows` as one, matrices with a leading axis (k)."""
    matrices, start = [], 0
    for height, width in site.shapes:
        block = rows[:, start : start + height * width].reshape(len(rows), width, height)
        matrices.append(np.ascontiguousarray(block.swapaxes(1, 2)))
        start += height * width
    return assemble(site.kind, site.affine, matrices, _channels_of(site))


def site_of_entries(site: SiteJacobians, flat: Sequence[Any]) -> LinearSite:
    """Return the site of a function's output over another kind of number (see `exact`)."""
    entries = np.empty(len(flat), dtype=object)
    entries[:] = list(flat)
    return assemble(site.kind, site.affine, cut(entries, site.shapes), _channels_of(site))


def site_of_row(site: SiteJacobians, row: NDArray[np.float64]) -> LinearSite:
    """Return the site of one row of `linearize_rows`."""
    return assemble(site.kind, site.affine, cut(row, site.shapes), _channels_of(site))


def _channels_of(site: SiteJacobians) -> list[tuple[tuple[int, ...], ...]]:
    """Return the channels each partition's receives depend on."""
    return [tick.channels for tick in site.pattern.ticks]
