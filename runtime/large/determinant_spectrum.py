"""The spectrum of a population by its characteristic function: bounds, verdict, the largest modes.

Takes: loops with long delays, or populations of different peers on complete graphs.
Gives: `solve_loops`, `solve_populations`; `frequency_of`.
Guarantees: as `zeros`: the radius is bounded from both sides, and nothing beyond it is missed; a verdict
nearer to the boundary than its bound says so. Rigid modes are known from the equations.
Does not: list more than the largest modes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import Loop, without_packets
from apc.eigen.eigenpairs import eigenpairs
from apc.eigen.rigid import find_rigid_modes
from apc.eigen.spectrum import Mode, Spectrum, judge
from apc.frame.exchange import Exchange
from apc.frame.lift import FrameMap
from apc.large.characteristic import Characteristic, matrices_in, null_vectors, weights_in
from apc.large.determinant import Places, heard_weights, of_loop, of_populations, senders_of
from apc.large.populations import (
    Population,
    hear_roughly,
    lines_of,
    mode_of,
    rows_of,
    site_one,
    some_rows,
    state_names,
    turned_by,
)
from apc.large.transfer import CHUNK, respond
from apc.large.zeros import Zero, Zeros, find_zeros, near_poles

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Modes listed of each system; of many peers fewer, as the shares of all peers are worked out for each.
LISTED, LISTED_OF_MANY, MANY = 5, 1, 20_000

# Poles of a population's sites that zeros are looked for close to.
NEAR_POLES = 6

# Peers of a population whose copies, all equal, tell where its common zeros may be.
SAMPLES = 2

# Smaller eigenvalues of these decide nothing, and those this near to 1 are rigid.
LEAST_START, SAME_START = 0.5, 1e-9

# Zeros of a loop that Newton's method starts from, the largest by their estimate.
STARTS = 64

# How far aside of an eigenvalue, relatively, its vectors are looked for by inverse iteration.
BESIDE = 1e-10


@dataclass(frozen=True, slots=True)
class _Solved:
    """One system: what its zeros say, and its modes."""

    zeros: Zeros
    rigid: int
    drifts: int
    modes: tuple[Mode, ...]


def solve_loops(loops: Sequence[Loop]) -> Spectrum:
    """Compute the spectrum of a whole system given as independent loops, delays of any length.

    Parameters
    ----------
    loops
        The loops, each counted as often as its multiplicity says.
    """
    return _spectrum([_solve_loop(loop) for loop in loops], [loop.multiplicity for loop in loops])


def solve_populations(listed: Sequence[Population], exchange: Exchange, *, rigid: int) -> Spectrum:
    """Compute the spectrum of different peers on complete graphs.

    Parameters
    ----------
    listed
        All peers.
    exchange
        The links, all of them complete.
    rigid
        How many common translations there are, from the equations (see `translation`).
    """
    function, places = of_populations(listed, exchange)
    peers = int(sum(len(population.parameters) for population in listed))
    zeros = find_zeros(
        function,
        _common_starts(listed, exchange),
        rigid=rigid,
        listed=LISTED_OF_MANY if peers > MANY else LISTED,
        near=NEAR_POLES,
    )
    modes = _with_conjugates(_population_mode(function, places, listed, zero) for zero in zeros.found)
    return _spectrum([_Solved(zeros, rigid, 0, modes)], [1])


def _spectrum(solved: Sequence[_Solved], multiplicities: Sequence[int]) -> Spectrum:
    """Put the answers of independent systems together."""
    modes = sorted(
        (mode for one in solved for mode in one.modes),
        key=lambda mode: (-mode.magnitude, mode.shape, mode.eigenvalue.real, -mode.eigenvalue.imag),
    )
    low = max(one.zeros.low for one in solved)
    high = max(one.zeros.high for one in solved)
    radius = max(one.zeros.radius for one in solved)
    rigid = sum(one.rigid * many for one, many in zip(solved, multiplicities, strict=True))
    drifts = sum(one.drifts * many for one, many in zip(solved, multiplicities, strict=True))
    inside = [False if one.zeros.low > 1 else True if one.zeros.high < 1 else None for one in solved]
    verdict, stable = judge(inside, rigid, drifts)
    notes = ["the largest modes only; that none is larger was counted by the argument principle"]
    if not all(one.zeros.counted for one in solved):
        notes = ["the largest modes found; the count that none is larger was had farther out only"]
    error = max(high - radius, radius - low, 0.0)
    return Spectrum(tuple(modes), radius, error, rigid, drifts, verdict, stable, "", tuple(notes))


def _solve_loop(loop: Loop) -> _Solved:
    """Find the largest modes of a loop."""
    function = of_loop(loop.sites, loop.coupling, loop.doubts)
    prompt = without_packets(loop)
    rigid, drifts = len(find_rigid_modes(prompt, with_drifts=False).names), 0
    starts = _delay_starts(function)
    zeros = find_zeros(function, starts, rigid=rigid, listed=LISTED, near=0)
    if (
        rigid
        and np.isfinite(zeros.high)
        and not zeros.rigid_counted
        and (drifts := find_rigid_modes(loop).drifts)
    ):
        zeros = find_zeros(function, starts, rigid=rigid + drifts, listed=LISTED, near=0)
    modes = _with_conjugates(_loop_mode(function, loop, zero) for zero in zeros.found)
    return _Solved(zeros, rigid, drifts, modes)


def frequency_of(loop: Loop, value: complex) -> float:
    """Return the frequency in Hz of the motion of an eigenvalue of a loop, whole turns in a frame counted."""
    function = of_loop(loop.sites, loop.coupling, loop.doubts)
    return _loop_mode(function, loop, Zero(value, 0.0, 1)).frequency_hz


def _delay_starts(function: Characteristic) -> Complexes:
    """Return where the zeros of a loop with a long delay d are about.

    Where k is an eigenvalue of T(ζ) W(ζ) ζ^d, f has a zero if ζ^d = k(ζ): near the unit circle ζ is
    |k|^(1/d) times a d-th root of 1, turned by what k is turned.
    """
    delay = max(1, function.longest)
    turns = np.arange(delay // 2 + 1)
    on_circle = np.exp(2j * np.pi * turns / delay) * (1 + 1e-9)
    around = np.eye(function.transfer.shape[0]) - matrices_in(function, on_circle, np.zeros(len(turns)))[:, 0]
    gain = np.linalg.eigvals(around) * (on_circle**delay)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = (np.log(gain) + 2j * np.pi * turns[:, None]) / delay
    starts = np.exp(logarithm).ravel()
    largest = np.sort(np.abs(starts[np.isfinite(starts)]))[-STARTS:] if len(starts) else starts
    starts = starts[np.abs(starts) >= largest.min(initial=np.inf)]
    poles = near_poles(function, NEAR_POLES)
    return np.concatenate([starts, poles * (1 + 1e-3), poles * (1 - 1e-3)])


def _common_starts(listed: Sequence[Population], exchange: Exchange) -> Complexes:
    """Return the eigenvalues of populations of copies of one peer, for some peers: all moving alike."""
    found = [np.zeros(0, np.complex128)]
    weights = zip(heard_weights(listed, exchange), senders_of(listed, exchange), strict=True)
    for population, (weight, senders) in zip(listed, weights, strict=True):
        few = np.unique(np.linspace(0, len(population.parameters) - 1, SAMPLES).astype(np.int64))
        own = np.tile(weight * senders, (len(few), 1))
        alike = hear_roughly(some_rows(population.lifted, few), population.schedule, own, 0 * own)
        values = np.linalg.eigvals(alike.p).astype(np.complex128).ravel()
        kept = (values.imag >= 0) & (np.abs(values) > LEAST_START) & (np.abs(values - 1) > SAME_START)
        found.append(values[kept])
    return np.concatenate(found)


def _loop_mode(function: Characteristic, loop: Loop, zero: Zero) -> Mode:
    """Describe a zero of a loop; the packets of a channel on their way count together."""
    value = zero.value * (1 + BESIDE)
    motions, sent = _nearly_free(function, loop, value)
    felt = np.concatenate([one.felt[0] for one in motions])
    waiting = _waiting(function, value, felt, function.longest)
    lags = np.arange(1, len(waiting) + 1)[:, None]
    on_the_way = np.abs(waiting * sent * value ** -lags.astype(np.float64))
    shares: dict[str, float] = {}
    place = 0
    for group, motion in zip(loop.sites, motions, strict=True):
        prefix = f"{group.name}." if len(loop.sites) > 1 else ""
        for name, share in zip(group.lifted.z_names, np.abs(motion.w[0] * motion.z[0]), strict=True):
            shares[prefix + name] = float(share)
        for name, depth in zip(group.schedule.sent_names, group.schedule.depths, strict=True):
            share = float(on_the_way[:depth, place].sum())
            shares[prefix + name] = shares.get(prefix + name, 0.0) + share
            place += 1
    dominant = max(range(len(motions)), key=lambda g: float(np.abs(motions[g].w * motions[g].z).max()))
    motion, own = motions[dominant], loop.sites[dominant]
    turned = turned_by(own.site, own.schedule, zero.value, motion.z[0], motion.r[0], motion.w[0])
    return mode_of(zero.value, zero.error, turned, shares, loop.name, loop.multiplicity)


def _nearly_free(function: Characteristic, loop: Loop, value: complex) -> tuple[list[_Motion], Complexes]:
    """Return how the sites move next to an eigenvalue when all is pushed a little, and what they send.

    Inverse iteration: it serves where I − T W has no null vector too, at a pole that is an eigenvalue. Any
    push will do that no symmetry of the scene is blind to.
    """
    random = np.random.default_rng(0)
    pushes = [random.uniform(0.5, 1.0, (1, len(group.lifted.p))) for group in loop.sites]
    maps = [rows_of(group.lifted, 1) for group in loop.sites]
    alone = [
        _move(one, value, np.zeros((1, one.q.shape[2])), np.zeros(one.s.shape[1]), push)
        for one, push in zip(maps, pushes, strict=True)
    ]
    at = np.array([value]), np.zeros(1)
    answer, hearing = respond(function.transfer, *at)[0, 0], weights_in(function, *at)[0, 0]
    sent_alone = np.concatenate(
        [(one.s @ moved.z[..., None])[0, :, 0] for one, moved in zip(maps, alone, strict=True)]
    )
    sent = np.linalg.solve(np.eye(len(answer)) - answer @ hearing, sent_alone)
    felt_alone = np.concatenate([one.felt[0] for one in alone])
    felt = np.linalg.solve((np.eye(len(hearing)) - hearing @ answer).T, felt_alone)
    heard, weight = hearing @ sent, felt @ hearing
    motions = []
    s_start = r_start = 0
    for one, push in zip(maps, pushes, strict=True):
        rows = slice(s_start, s_start + one.s.shape[1])
        lines = slice(r_start, r_start + one.q.shape[2])
        s_start, r_start = rows.stop, lines.stop
        motions.append(_move(one, value, heard[None, lines], weight[rows], push))
    return motions, sent


def _population_mode(
    function: Characteristic, places: Places, listed: Sequence[Population], zero: Zero
) -> Mode:
    """Describe a zero of a heterogeneous population; the shares of a population's peers are added up."""
    if zero.site:
        return _own_mode(listed[zero.site[0]], places, zero, zero.site)
    value = zero.value
    sent, weight = null_vectors(function, value)
    heard = weights_in(function, np.array([value]), np.zeros(1))[0, 0] @ sent
    motions = [
        _move_population(
            population, places.own[g], places.others[g], value, heard[places.heard[g]], weight[places.sent[g]]
        )
        for g, population in enumerate(listed)
    ]
    felt = np.zeros(len(heard), np.complex128)
    for g, (population, motion) in enumerate(zip(listed, motions, strict=True)):
        felt[places.heard[g]] += population.counts @ motion.felt
    waiting = _waiting(function, value, felt, function.longest)
    shares: dict[str, float] = {}
    most, dominant = -1.0, (0, 0)
    for g, (population, motion) in enumerate(zip(listed, motions, strict=True)):
        n_z = len(population.lifted.z_names)
        covector = motion.w.copy()
        place = n_z
        for row, depth in enumerate(population.schedule.depths):
            covector[:, place : place + depth] += waiting[:depth, places.sent[g][row]]
            place += depth
        own = np.abs(covector * motion.z)
        for name, share in zip(state_names(population), population.counts @ own, strict=True):
            name = f"{population.name}.{name}" if len(listed) > 1 else name
            shares[name] = shares.get(name, 0.0) + float(share)
        peer = int(np.argmax(own.sum(axis=1)))
        if float(own[peer].sum()) > most:
            most, dominant = float(own[peer].sum()), (g, peer)
    g, peer = dominant
    motion, site = motions[g], site_one(listed[g], peer)
    turned = turned_by(site, listed[g].schedule, zero.value, motion.z[peer], motion.r[peer], motion.w[peer])
    return mode_of(zero.value, zero.error, turned, shares, "different peers", zero.multiplicity)


def _own_mode(population: Population, places: Places, zero: Zero, site: tuple[int, int]) -> Mode:
    """Describe an eigenvalue of one peer by itself: of equal peers moving apart, or of one nobody hears."""
    g, row = site
    some = some_rows(population.lifted, slice(row, row + 1))
    own, others = places.own[g], places.others[g]
    alone = hear_roughly(some, population.schedule, own[None], others[None])
    pairs = eigenpairs(alone.p[0])
    nearest = int(np.argmin(np.abs(pairs.values - zero.value)))
    z, w = pairs.right[:, nearest], pairs.left[nearest]
    now, before, _ = lines_of(population.schedule)
    n_z = some.p.shape[-1]
    received = own * (now @ (alone.s[0] @ z) + before @ z[n_z:])
    shares: dict[str, float] = {}
    for name, share in zip(state_names(population), np.abs(w * z).tolist(), strict=True):
        shares[name] = shares.get(name, 0.0) + share
    turned = turned_by(site_one(population, row), population.schedule, zero.value, z, received, w)
    return mode_of(zero.value, zero.error, turned, shares, f"{population.name} by itself", zero.multiplicity)


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Sites in a mode: their states z (k, n), what weighs these, w (k, n), and what they hear, r (k, n_r).

    `felt` (k, n_r) weighs what comes from outside.
    """

    z: Complexes
    w: Complexes
    r: Complexes
    felt: Complexes


def _move(
    maps: FrameMap,
    value: complex,
    heard: Complexes | Floats,
    weight: Complexes | Floats,
    push: Floats | float = 0.0,
) -> _Motion:
    """Return how sites move at ζ, hearing r (k, n_r) from outside, with what they send weighed by χ (n_s,).

    (ζ − P) z = Q r + v and w (ζ − P) = χ S + v, pushed by v (k, n); w Q + χ D weighs r.
    """
    p, q, s, d = maps.blocks
    shifted = value * np.eye(p.shape[-1]) - p
    driven = (q @ heard[..., None])[..., 0] + push
    z: Complexes = np.linalg.solve(shifted, driven[..., None])[..., 0].astype(np.complex128)
    covector = (weight @ s + push)[..., None]
    w: Complexes = np.linalg.solve(shifted.swapaxes(1, 2), covector)[..., 0].astype(np.complex128)
    return _Motion(z, w, heard.astype(np.complex128), (w[:, None, :] @ q)[:, 0] + weight @ d)


def _move_population(
    population: Population, own: Floats, others: Floats, value: complex, heard: Complexes, weight: Complexes
) -> _Motion:
    """Return how the peers of a population move, each hearing itself by `own` (n_r,), a chunk at a time."""
    parts = []
    now, before, _ = lines_of(population.schedule)
    for start in range(0, len(population.parameters), CHUNK):
        some = some_rows(population.lifted, slice(start, start + CHUNK))
        k = len(some.p)
        alone = hear_roughly(some, population.schedule, np.tile(own, (k, 1)), np.tile(others, (k, 1)))
        moved = _move(alone, value, np.tile(heard, (k, 1)), weight)
        sent = (alone.s @ moved.z[..., None] + alone.d @ moved.r[..., None])[..., 0]
        packets = moved.z[:, some.p.shape[-1] :]
        received = others * heard + own * (sent @ now.T + packets @ before.T)
        parts.append(replace(moved, r=received))
    return _Motion(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Motion.__slots__))


def _waiting(function: Characteristic, value: complex, felt: Complexes, depth: int) -> Complexes:
    """Return what weighs a packet l = 1 … depth frames old, (depth, n_s): all who still hear it."""
    n_s, n_r = function.transfer.shape
    found = np.zeros((depth, n_s), np.complex128)
    weights = function.weights[0].reshape(len(function.lags), n_r, n_s)
    for lag, weight in zip(function.lags.tolist(), weights, strict=True):
        ages = np.arange(1, lag + 1)
        found[:lag] += (value ** (ages - lag - 1).astype(np.float64))[:, None] * (felt @ weight)
    return found


def _with_conjugates(modes: Iterable[Mode]) -> tuple[Mode, ...]:
    """Return modes with the conjugate of each that is complex."""
    found = []
    for mode in modes:
        found.append(mode)
        if mode.eigenvalue.imag:
            found.append(replace(mode, eigenvalue=mode.eigenvalue.conjugate()))
    return tuple(found)
