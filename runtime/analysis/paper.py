"""The analysis as the paper writes it: cut at every force, lifted over a frame, delayed, closed again.

Takes: a `CompiledSystem` of the paper's form: linear, at rest or translating, with one clock of forces and
one network clock at a whole multiple of its period.
Gives: `NamedMatrix`, `PaperRoute`, `paper_route`, `analyze_paper`.
Guarantees: every matrix names its rows and columns; the nonzero eigenvalues are those of the direct route. A
scene of another form is refused with what it lacks.
Does not: split equal peers into modes, so it costs (4nR)³ for n peers at ratio R.

Rakhsha and Constantinescu, eqs. (7) to (20), after Araki and Yamamoto (IEEE Trans. Automatic Control 31,
1986) and Fotoohi et al. (Int. J. Robotics Research 26, 2007). With x of all peers, u_c what a force makes of
its own peer's samples, u_n what it makes of the others' packets, and y_n what is heard:

    dx/dt = A x + B (u_c, u_n),   y = (x, y_n) = C x                                           (18)

A force that has both parts counts as two inputs, through one column of B each. The blocks that follow are not
printed; these have the printed shapes. With R force ticks a frame:

    x_D = (x at the R force ticks up to the frame's start, the newest last)
    u_D = (u_c at the R force ticks of the frame, u_n),   y_D = (x at these ticks, y_n)
    x_D⁺ = A_D x_D + B_D u_D,   y_D = C_D x_D + D_D u_D                                        (19)
    u_D = F_D y_D,   A_cl = A_aug + B_aug F_D (I − D_aug F_D)⁻¹ C_aug                          (20)

The augmented state holds, after x_D, the forces still to act and the y_n still to arrive. D_aug F_D is
nilpotent: a force moves later samples only. All matrices are computed with their radii (see `frame.radius`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, lifted_groups
from apc.analysis.methods import PAPER
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.closing import ClosedSystem, Feedback, StateLayout, close
from apc.eigen.modes import dense
from apc.eigen.peer_group import PeerGroup
from apc.eigen.relative import relative_bounded, relative_coordinates, relative_places
from apc.eigen.rigid import RigidModes, find_rigid_modes
from apc.eigen.spectrum import STABLE, STABLE_TRANSLATING, Spectrum, solve_spectrum
from apc.finite_equations import finite_equations
from apc.frame.discretize import UNIT, discretize
from apc.frame.lift import FrameMap
from apc.frame.radius import RADII, radius_of, rounded, value_of, with_radius
from apc.frame.schedule import Way
from apc.network.nominal import left_out
from apc.result import Result
from apc.threads import single_threaded

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# More rows than this of y_D are refused: four dense matrices of that size already fill 100 MB.
MOST_ROWS = 1800

# What a scene of another form can do instead.
_INSTEAD = "--method modes, which asks for none of it"


@dataclass(frozen=True, slots=True, eq=False)
class NamedMatrix(Result):
    """A matrix (rows, columns) and what its rows and columns are."""

    shown_by = "analysis:matrix"

    values: Floats
    rows: tuple[str, ...]
    columns: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and of columns."""
        return len(self.rows), len(self.columns)


@dataclass(frozen=True, slots=True, eq=False)
class PaperRoute(Result):
    """Every matrix of the paper's section III, for n peers at ratio R.

    `a`, `b`, `c` are eq. (18); `a_d`, `b_d`, `c_d`, `d_d` eq. (19), without delays; `a_aug` … `d_aug` the
    same with the delays; `f_d` the feedback; `closed` A_cl of eq. (20); `eigenvalues` its eigenvalues, the
    largest first, rigid ones included.
    """

    shown_by = "analysis:paper_route"

    ratio: int
    frame_s: float
    a: NamedMatrix
    b: NamedMatrix
    c: NamedMatrix
    a_d: NamedMatrix
    b_d: NamedMatrix
    c_d: NamedMatrix
    d_d: NamedMatrix
    a_aug: NamedMatrix
    b_aug: NamedMatrix
    c_aug: NamedMatrix
    d_aug: NamedMatrix
    f_d: NamedMatrix
    closed: NamedMatrix
    eigenvalues: NDArray[np.complex128]


def paper_route(system: CompiledSystem) -> PaperRoute:
    """Return the matrices of the paper's route.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.

    Raises
    ------
    ApcError
        E861 the scene has not the form the route is written for: the message says what is missing. E862 it
        has, but the matrices would be too large. And whatever the analysis of the scene raises.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        return _named(_open_loop(system, dense(*lifted_groups(system))))


def analyze_paper(system: CompiledSystem) -> Analysis:
    """Analyse a system by the paper's route.

    The rigid motions are removed by their known directions, so the modes' participation is in relative
    coordinates: a translation's own share is nobody's.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.

    Raises
    ------
    ApcError
        As `paper_route`; E861 also a scene that drifts.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        whole = dense(*lifted_groups(system))
        loop = _open_loop(system, whole)
        rigid = find_rigid_modes(whole)
        if rigid.drifts:
            raise _not_of_the_form(system, {"a scene in which nothing drifts": None})
        spectrum = _with_turns(solve_spectrum([_without_rigid(loop, whole, rigid)]), solve_spectrum([whole]))
    translations = len(rigid.names)
    translates = bool(translations) and spectrum.verdict == STABLE
    zero, size = (loop.ratio - 1) * len(loop.states), loop.starts[-1]
    return Analysis(
        topology=system.name,
        peers=system.peers,
        frame_s=loop.frame_s,
        states_per_peer=-(-(size - zero) // system.peers),
        method=PAPER,
        verdict=STABLE_TRANSLATING if translates else spectrum.verdict,
        stable=spectrum.stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        rigid_modes=translations,
        translations=translations,
        modes=spectrum.modes,
        linearized=False,
        notes=(
            f"A_cl is {size} × {size}; {zero} of its columns are zero and as many eigenvalues with them",
            *spectrum.notes,
        ),
        left_out=left_out(system),
    )


# ---- eq. (18): the loop cut open ----


@dataclass(frozen=True, slots=True)
class _Signal:
    """An input or a row of y_n: Σ weight · (the entry at place), `delay` force ticks or frames late."""

    name: str
    delay: int
    weights: Mapping[int, Fraction]


@dataclass(frozen=True, slots=True)
class _Input(_Signal):
    """An input, which acts through column `hold` of the B of site `site`; its places are in x or in y_n."""

    site: int
    hold: int


@dataclass(frozen=True, slots=True, eq=False)
class _OpenLoop:
    """Eq. (18) with what the delays and the feedback need; `step` is [F G_c G_n] of one force period."""

    ratio: int
    period: Fraction  # s
    states: tuple[str, ...]
    fast: tuple[_Input, ...]  # u_c, over x
    slow: tuple[_Input, ...]  # u_n, over y_n
    heard: tuple[_Signal, ...]  # y_n, over x
    ab: Floats  # [A B] (n, n + n_u)
    step: Matrix  # (2, n, n + n_u), with its radii

    @property
    def frame_s(self) -> float:
        """The length of a frame in seconds."""
        return float(self.ratio * self.period)

    @property
    def depths(self) -> list[int]:
        """How many values of each input, and of each row of y_n, are on their way at a frame's start."""
        frames = [-(-one.delay // self.ratio) for one in self.slow]
        return [one.delay for one in self.fast] + frames + [one.delay for one in self.heard]

    @property
    def starts(self) -> list[int]:
        """Where these stand in the augmented state, and how large that is."""
        first = self.ratio * len(self.states)
        return list(itertools.accumulate(self.depths, initial=first))

    @property
    def c_n(self) -> Matrix:
        """Return y_n over x, exactly."""
        return _rows(self.heard, len(self.states))


def _rows(signals: Sequence[_Signal], width: int) -> Matrix:
    """Return the weights of signals as an exact matrix (len(signals), width)."""
    matrix = np.full((len(signals), width), Fraction(0), dtype=object)
    for line, one in enumerate(signals):
        for place, weight in one.weights.items():
            matrix[line, place] = weight
    return matrix


def _floats(exact: Matrix) -> Floats:
    return exact.astype(np.float64)


def _open_loop(system: CompiledSystem, whole: ClosedSystem) -> _OpenLoop:
    """Cut the loop of all peers at every force."""
    sites = whole.sites
    period, frame = _periods(system, sites)
    ratio = int(frame / period)
    timings = {timing.name: timing.value for timing in system.timings}
    starts = [0, *itertools.accumulate(len(group.jacobians.kind.states) for group in sites)]
    if (starts[-1] + 2 * len(sites)) * ratio > MOST_ROWS:
        what = (
            f"the paper's matrices for {len(sites)} peers at {ratio} force ticks a frame have more than "
            f"{MOST_ROWS:,} rows"
        )
        raise ApcError(Mistake("E862", Place(system.origin.topology), what, hint=_INSTEAD))
    heard: list[_Signal] = []
    fast: list[_Input] = []
    slow: list[_Input] = []
    for i, group in enumerate(sites):
        kind, ticks = group.jacobians.kind, group.exact.ticks
        place_of: dict[tuple[Way, str], int] = {}
        several = len({one.way.delay for one in group.schedule.heard}) > 1
        for p, partition in enumerate(kind.clocks):
            pairs = (pair for k in range(len(partition.receives)) for pair in group.schedule.ways(p, k))
            for way, channel in pairs:
                if (way, channel) in place_of:
                    continue
                place_of[way, channel] = len(heard)
                delay = int(timings[way.delay] / frame)
                name = f"{group.name}.{way.operator}(others.{channel})"
                name += f" {delay} frames late" if several else ""
                heard.append(_Signal(name, delay, _sent(whole, way, channel, i, starts)))
        partition_of = {partition.clock: p for p, partition in enumerate(kind.clocks)}
        for h, hold in enumerate(kind.holds):
            if group.schedule.acting[h] is None:
                continue
            p, name = partition_of[hold.clock], f"{group.name}.{hold.name}"
            delay = int(timings[hold.delay] / period)
            pattern = group.jacobians.pattern.ticks[p]
            received = pattern.r[hold.output].any()
            if pattern.x[hold.output].any() or not received:
                weights = {starts[i] + k: Fraction(w) for k, w in enumerate(ticks[p].x[hold.output]) if w}
                fast.append(_Input(f"{name} own" if received else name, delay, weights, i, h))
            if received:
                weights = {}
                for k, w in enumerate(ticks[p].r[hold.output]):
                    for one in group.schedule.ways(p, k) if w else ():
                        weights[place_of[one]] = weights.get(place_of[one], Fraction(0)) + Fraction(w)
                slow.append(_Input(f"{name} received", delay, weights, i, h))
    inputs = (*fast, *slow)
    steps = {id(g.site): discretize(g.exact.a, g.exact.b, [period])[0] for g in sites}
    blocks = [steps[id(group.site)] for group in sites]
    return _OpenLoop(
        ratio=ratio,
        period=period,
        states=tuple(f"{group.name}.{one.name}" for group in sites for one in group.jacobians.kind.states),
        fast=tuple(fast),
        slow=tuple(slow),
        heard=tuple(heard),
        ab=_side_by_side([np.hstack([g.site.a, g.site.b]) for g in sites], inputs, starts),
        step=_side_by_side(
            [with_radius(one.matrix, one.roundings * UNIT * one.size) for one in blocks], inputs, starts
        ),
    )


def _side_by_side(blocks: Sequence[Matrix], inputs: Sequence[_Input], starts: Sequence[int]) -> Matrix:
    """Return the blocks [A B] (…, n_x, n_x + n_u) of the sites as one of all states and inputs."""
    n = starts[-1]
    found = np.zeros((*blocks[0].shape[:-2], n, n + len(inputs)))
    for block, (first, last) in zip(blocks, itertools.pairwise(starts), strict=True):
        found[..., first:last, first:last] = block[..., : last - first]
    for column, one in enumerate(inputs, n):
        first, last = starts[one.site], starts[one.site + 1]
        found[..., first:last, column] = blocks[one.site][..., last - first + one.hold]
    return found


def _sent(
    whole: ClosedSystem, way: Way, channel: str, receiver: int, starts: Sequence[int]
) -> dict[int, Fraction]:
    """Return what a site hears on a way, of one channel, over x."""
    found: dict[int, Fraction] = {}
    for j, (weight, group) in enumerate(zip(whole.coupling[way][receiver], whole.sites, strict=True)):
        for sending, send in zip(group.jacobians.kind.sends, group.exact.sends, strict=True):
            if weight and sending.link == way.link and channel in sending.channels:
                for place, k in enumerate(send.x[sending.channels.index(channel)], starts[j]):
                    if k:
                        found[place] = found.get(place, Fraction(0)) + weight * Fraction(k)
    return found


# ---- eqs. (19) and (20): lifted, delayed, closed ----


def _lift(loop: _OpenLoop) -> FrameMap:
    """Return A_aug, B_aug, C_aug and D_aug with their radii: a frame of force ticks, one after the other."""
    n, n_c, ratio, starts = len(loop.states), len(loop.fast), loop.ratio, loop.starts
    inputs = (*loop.fast, *loop.slow)
    size, forces = starts[-1], ratio * n_c + len(loop.slow)
    # Rows over the augmented state and u_D.
    unit = RADII.exact(np.eye(size + forces))

    def value(i: int, number: int) -> int:
        """Return the column of an input's value of that number in the frame, of earlier ones below 0."""
        if number < 0:
            return starts[i] - number - 1
        return size + (number * n_c + i if i < n_c else ratio * n_c + i - n_c)

    course = [unit[:, (ratio - 1) * n : ratio * n]]
    for tick in range(ratio):
        late = [tick - one.delay for one in inputs]
        acting = [value(i, by if i < n_c else by // ratio) for i, by in enumerate(late)]
        course.append(RADII.multiply(loop.step, np.concatenate([course[-1], unit[:, acting]], axis=1)))
    waiting, outputs = [], []
    for i in range(len(inputs)):
        newest = ratio if i < n_c else 1
        columns = [value(i, newest - age) for age in range(1, loop.depths[i] + 1)]
        waiting.append(unit[:, np.array(columns, dtype=np.intp)])
    heard = RADII.multiply(rounded(_floats(loop.c_n)), course[0])
    for row, (one, start) in enumerate(zip(loop.heard, starts[len(inputs) :], strict=False)):
        line = np.concatenate([heard[:, row : row + 1], unit[:, start : start + one.delay]], axis=1)
        waiting.append(line[:, : one.delay])
        outputs.append(line[:, one.delay :])
    moved = np.concatenate([*course[1:], *waiting], axis=1)
    seen = np.concatenate([*course[:-1], *outputs], axis=1)
    return FrameMap(moved[..., :size], moved[..., size:], seen[..., :size], seen[..., size:])


def _feedback(loop: _OpenLoop) -> Floats:
    """Return F_D: the forces of each tick of the samples there, and those of what is heard."""
    n, n_c, ratio = len(loop.states), len(loop.fast), loop.ratio
    f = np.zeros((ratio * n_c + len(loop.slow), ratio * n + len(loop.heard)))
    f[: ratio * n_c, : ratio * n] = np.kron(np.eye(ratio), _floats(_rows(loop.fast, n)))
    f[ratio * n_c :, ratio * n :] = _floats(_rows(loop.slow, len(loop.heard)))
    return f


def _close(delayed: FrameMap, f: Floats) -> Matrix:
    """Return A_cl of eq. (20) with its radii."""
    size = delayed.p.shape[-1]
    feedback = Feedback(rounded(f), np.zeros((2, len(f), size)))
    return close([delayed], [feedback], StateLayout((0,), ("",) * size, {}), numbers=RADII).matrix


def _named(loop: _OpenLoop) -> PaperRoute:
    """Return every matrix with the names of its rows and columns."""
    n, ratio = len(loop.states), loop.ratio
    fast, slow = (tuple(replace(one, delay=0) for one in signals) for signals in (loop.fast, loop.slow))
    at_once = replace(loop, fast=fast, slow=slow, heard=tuple(replace(one, delay=0) for one in loop.heard))
    f, lifted, delayed = _feedback(loop), _lift(at_once), _lift(loop)
    closed = value_of(_close(delayed, f))
    ticks = [float(j * loop.period * 1000) for j in range(1 - ratio, ratio)]
    forces, received, heard = ([one.name for one in signals] for signals in (fast, slow, loop.heard))
    stacked = _timed(loop.states, ticks[:ratio])
    augmented = (*stacked, *_waiting_names(loop))
    inputs = (*_timed(forces, ticks[ratio - 1 :]), *received)
    outputs = (*_timed(loop.states, ticks[ratio - 1 :]), *heard)
    values = np.zeros(len(closed), dtype=np.complex128)
    alive = slice((ratio - 1) * n, None)  # the columns before are zero, and so are as many eigenvalues
    values[alive] = np.linalg.eigvals(closed[alive, alive])
    return PaperRoute(
        ratio=ratio,
        frame_s=loop.frame_s,
        a=NamedMatrix(loop.ab[:, :n], loop.states, loop.states),
        b=NamedMatrix(loop.ab[:, n:], loop.states, (*forces, *received)),
        c=NamedMatrix(np.vstack([np.eye(n), _floats(loop.c_n)]), (*loop.states, *heard), loop.states),
        **_blocks("d", lifted, stacked, inputs, outputs),
        **_blocks("aug", delayed, augmented, inputs, outputs),
        f_d=NamedMatrix(f, inputs, outputs),
        closed=NamedMatrix(closed, augmented, augmented),
        eigenvalues=values[np.lexsort((-values.imag, values.real, -np.abs(values)))],
    )


def _blocks(
    suffix: str, lifted: FrameMap, states: tuple[str, ...], inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> dict[str, NamedMatrix]:
    """Return A, B, C and D of a lifted system by their names in `PaperRoute`."""
    shapes = ((states, states), (states, inputs), (outputs, states), (outputs, inputs))
    return {
        f"{letter}_{suffix}": NamedMatrix(value_of(block), *shape)
        for letter, block, shape in zip("abcd", lifted.blocks, shapes, strict=True)
    }


def _timed(names: Sequence[str], times: Sequence[float]) -> tuple[str, ...]:
    """Return every name at every time, in ms: `user[1].cube.x(-1 ms)`."""
    return tuple(f"{name}({time:.6g} ms)" for time in times for name in names)


def _waiting_names(loop: _OpenLoop) -> tuple[str, ...]:
    """Return the names of the augmented states behind x_D: forces still to act, and y_n still to arrive."""
    frame = loop.ratio * loop.period
    signals = (*loop.fast, *loop.slow, *loop.heard)
    return tuple(
        f"{one.name}({-age * float((loop.period if i < len(loop.fast) else frame) * 1000):.6g} ms)"
        for i, (one, depth) in enumerate(zip(signals, loop.depths, strict=True))
        for age in range(1, depth + 1)
    )


# ---- the analysis: rigid motions out, then eigenvalues ----


def _without_rigid(loop: _OpenLoop, whole: ClosedSystem, rigid: RigidModes) -> ClosedSystem:
    """Return A_cl in relative coordinates, without its zero columns.

    As many positions are given up as there are rigid motions. Where x stands, so does all that is a form in
    it: what is still to act, and to be heard.
    """
    n, zero = len(loop.states), (loop.ratio - 1) * len(loop.states)
    closed = _close(_lift(loop), _feedback(loop))[..., zero:, zero:]
    motions = []
    for motion in rigid.exact:
        x = np.array([motion[place] for place in whole.motion], dtype=object)
        heard = loop.c_n @ x
        signals = [*(_rows(loop.fast, n) @ x), *(_rows(loop.slow, len(heard)) @ heard), *heard]
        motions.append([*x, *np.repeat(np.array(signals, dtype=object), loop.depths)])
    basis = np.array(motions, dtype=np.float64).reshape(len(motions), closed.shape[-1]).T
    held, _ = relative_places(basis[:n])
    rest = np.delete(np.arange(len(basis)), held)
    at = relative_coordinates(basis, (held, rest))
    matrix, error = relative_bounded(value_of(closed), radius_of(closed), at)
    names = (*loop.states, *_waiting_names(loop))
    return ClosedSystem(
        name=PAPER,
        multiplicity=1,
        sites=(),  # a matrix by itself, its rigid motions already out
        coupling={},
        frame_s=loop.frame_s,
        layout=StateLayout((0,), tuple(names[place] for place in rest), {}),
        matrix=matrix,
        error=error,
        heard=(),
        motion=tuple(range(n - len(held))),
    )


def _with_turns(spectrum: Spectrum, whole: Spectrum) -> Spectrum:
    """Return a spectrum with the frequencies of another of the same eigenvalues.

    The lifted matrices know a frame's ticks and nothing in between: whole turns there are counted elsewhere.
    """
    values = np.array([mode.eigenvalue for mode in whole.modes])
    modes = []
    for mode in spectrum.modes:
        if np.isnan(mode.frequency_hz):
            near = whole.modes[int(np.argmin(np.abs(values - mode.eigenvalue)))]
            if abs(near.eigenvalue - mode.eigenvalue) <= near.error + mode.error:
                same = replace(near.motion[0], participation=mode.participation)
                mode = replace(mode, motion=(same,))
        modes.append(mode)
    return replace(spectrum, modes=tuple(modes))


# ---- the paper's form ----


def _periods(system: CompiledSystem, sites: Sequence[PeerGroup]) -> tuple[Fraction, Fraction]:
    """Return T_c and T_n, or say everything that keeps a scene from having the paper's form."""
    timings = {timing.name: timing.value for timing in system.timings}
    clock_of = {clock.name: clock for clock in system.clocks}
    link_clock = {link.name: link.clock for link in system.links}
    missing: dict[str, None] = {}
    forces: dict[str, None] = {}
    networks: dict[str, None] = {}
    for group in {id(group.site): group for group in sites}.values():
        missing |= dict.fromkeys(_misfits(group))
        for h, hold in enumerate(group.jacobians.kind.holds):
            if group.schedule.acting[h] is not None:
                forces[hold.clock] = None
        networks |= {link_clock[one.way.link]: None for one in group.schedule.heard}
    for what, found in (("clock of forces", forces), ("network clock", networks)):
        if len(found) != 1:
            listed = f"here are {' and '.join(found)}" if found else "here is none"
            missing[f"one {what} ({listed})"] = None
    if missing:
        raise _not_of_the_form(system, missing)
    fast, slow = clock_of[next(iter(forces))], clock_of[next(iter(networks))]
    period, frame = timings[fast.period], timings[slow.period]
    if (frame / period).denominator != 1:
        missing[f"a network period that is a whole multiple of that of {fast.name}"] = None
    elif ((timings[slow.phase] - timings[fast.phase]) / period).denominator != 1:
        missing[f"ticks of {slow.name} that fall on ticks of {fast.name}"] = None
    for group in sites:
        for h, hold in enumerate(group.jacobians.kind.holds):
            if group.schedule.acting[h] is not None and (timings[hold.delay] / period).denominator != 1:
                missing[f"a computational delay of {hold.name} of whole ticks of {fast.name}"] = None
        for one in group.schedule.heard:
            if (timings[one.way.delay] / frame).denominator != 1:
                missing[f"a delay of {one.way.link} of whole ticks of {slow.name}"] = None
    if missing:
        raise _not_of_the_form(system, missing)
    return period, frame


def _misfits(group: PeerGroup) -> Iterator[str]:
    """Yield what a peer's own equations lack."""
    kind, pattern = group.jacobians.kind, group.jacobians.pattern
    if not group.site.affine:
        yield f"linear equations ({kind.name} is not linear)"
    for partition, tick in zip(kind.clocks, pattern.ticks, strict=True):
        if partition.variants:
            yield "forces that are the same at every tick (they follow the age of what is heard)"
        if any(receive.before for receive in partition.receives):
            yield "forces of what is heard now (what the tick before heard counts as well)"
        if tick.m.any():
            names = [partition.outputs[partition.memories[m]] for m in np.flatnonzero(tick.m.any(axis=0))]
            yield f"forces of the samples alone ({', '.join(names)} is remembered from tick to tick)"
        if tick.u.any():
            yield f"forces of the samples alone (on {partition.clock}, a held force is read)"
    if any(send.u.any() for send in pattern.sends):
        yield "packets of the motion alone (a held force is sent)"


def _not_of_the_form(system: CompiledSystem, missing: Mapping[str, None]) -> ApcError:
    what = "the paper's route is written for another form of scene; missing: " + "; ".join(missing)
    return ApcError(Mistake("E861", Place(system.origin.topology), what, hint=_INSTEAD))
