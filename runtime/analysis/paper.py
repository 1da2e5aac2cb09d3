"""The analysis as the paper writes it: cut at every force, lifted over a frame, delayed, closed again.

Takes: a `Model` of the paper's form: linear, at rest or translating, with one clock of forces and
one network clock at a whole multiple of its period.
Gives: `NamedMatrix`, `PaperMethod`, `paper_route`, `analyze_paper`.
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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, lifted_groups
from apc.analysis.methods import PAPER
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.closing import ClosedLoop, InterconnectionMatrices, StateLayout, close
from apc.eigen.modes import dense
from apc.eigen.peers import PeerClass
from apc.eigen.relative import relative_bounded, relative_coordinates, relative_places
from apc.eigen.rigid import RigidModes, find_rigid_modes, what_stands
from apc.eigen.spectrum import Spectrum, solve_spectrum, up_to
from apc.frame.discretize import discretize
from apc.frame.finite_equations import finite_equations
from apc.frame.lift import FrameMap
from apc.frame.radius import RADII, radius_of, rounded, value_of, with_radius
from apc.frame.schedule import CouplingTerm
from apc.network.nominal import left_out
from apc.result import Result
from apc.threads import load_pool, single_threaded
from apc.verdict import StabilityVerdict

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# More rows than this of y_D are refused: four dense matrices of that size already fill 100 MB.
MOST_ROWS = 1800

# What a scene of another form can do instead.
_INSTEAD = "--method modes, which asks for none of it"


@dataclass(frozen=True, slots=True, eq=False)
class NamedMatrix(Result):
    """A matrix (rows, columns) and what its rows and columns are."""

    shown_by = "analysis_output:matrix"

    values: Floats
    rows: tuple[str, ...]
    columns: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and of columns."""
        return len(self.rows), len(self.columns)


@dataclass(frozen=True, slots=True, eq=False)
class PaperMethod(Result):
    """Every matrix of the paper's section III, for n peers at ratio R.

    `a`, `b`, `c` are eq. (18); `a_d`, `b_d`, `c_d`, `d_d` eq. (19), without delays; `a_aug` … `d_aug` the
    same with the delays; `f_d` the feedback; `closed` A_cl of eq. (20); `eigenvalues` its eigenvalues, the
    largest first, rigid ones included.
    """

    shown_by = "analysis_output:paper_route"

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


def paper_route(system: Model) -> PaperMethod:
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


def analyze_paper(system: Model) -> Analysis:
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
            raise _not_of_the_form(system, ["a scene in which nothing drifts"])
        spectrum = _with_turns(solve_spectrum([_without_rigid(loop, whole, rigid)]), solve_spectrum([whole]))
    stands = what_stands(whole)
    zero, size = (loop.ratio - 1) * len(loop.states), loop.starts[-1]
    return Analysis(
        topology=system.name,
        peers=system.peers,
        frame_s=loop.frame_s,
        states_per_peer=-(-(size - zero) // system.peers),
        method=PAPER,
        verdict=(
            up_to(stands.translations, stands.rotations)
            if spectrum.verdict is StabilityVerdict.STABLE
            else spectrum.verdict
        ),
        stable=spectrum.stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        beyond=spectrum.beyond,
        rigid_modes=len(rigid.names),
        translations=stands.translations,
        rotations=stands.rotations,
        unfelt=stands.names,
        modes=spectrum.modes,
        linearized=False,
        notes=(
            f"A_cl is {size} × {size}; {zero} of its columns are zero and as many eigenvalues with them",
            *spectrum.notes,
        ),
        left_out=left_out(system),
    )


# ---- eq. (18): the loop cut open ----


@dataclass(frozen=True, slots=True, eq=False)
class _Signal:
    """An input, over x or over y_n, or a row of y_n, over x: its exact weights, and how late it is.

    An input is late by force ticks, a row of y_n by frames.
    """

    name: str
    delay: int
    weights: Matrix  # of `Fraction`


@dataclass(frozen=True, slots=True, eq=False)
class _OpenLoop:
    """Eq. (18) with what the delays and the feedback need; `step` is [F G_c G_n] of one force period."""

    ratio: int
    period: Fraction  # s
    states: tuple[str, ...]
    fast: tuple[_Signal, ...]  # u_c, over x
    slow: tuple[_Signal, ...]  # u_n, over y_n
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
        frames = [-(-item.delay // self.ratio) for item in self.slow]
        return [item.delay for item in self.fast] + frames + [item.delay for item in self.heard]

    @property
    def starts(self) -> list[int]:
        """Where these stand in the augmented state, and how large that is."""
        first = self.ratio * len(self.states)
        return list(itertools.accumulate(self.depths, initial=first))


def _weights(signals: Sequence[_Signal], width: int) -> Matrix:
    """Return the exact weights of signals (len(signals), width)."""
    return np.array([signal.weights for signal in signals], dtype=object).reshape(len(signals), width)


def _floats(signals: Sequence[_Signal], width: int) -> Floats:
    """Return the weights of signals (len(signals), width), each rounded once."""
    return _weights(signals, width).astype(np.float64)


def _open_loop(system: Model, whole: ClosedLoop) -> _OpenLoop:
    """Cut the loop of all peers at every force."""
    sites = whole.sites
    period, frame = _periods(system, sites)
    ratio = int(frame / period)
    timings = {timing.name: timing.value for timing in system.timings}
    starts = [0, *itertools.accumulate(len(group.jacobians.kind.states) for group in sites)]
    n = starts[-1]
    if (n + 2 * len(sites)) * ratio > MOST_ROWS:
        what = (
            f"the paper's matrices for {len(sites)} peers at {ratio} force ticks a frame have more than "
            f"{MOST_ROWS:,} rows"
        )
        raise ApcError(Diagnostic("E862", SourceLocation(system.origin.topology), what, hint=_INSTEAD))
    sent = [
        {
            (sending.link, channel): row
            for sending, send in zip(group.jacobians.kind.sends, group.exact.sends, strict=True)
            for channel, row in zip(sending.channels, send.x, strict=True)
        }
        for group in sites
    ]
    heard: dict[tuple[int, CouplingTerm, str], _Signal] = {}
    for i, group in enumerate(sites):
        several = len({heard.way.delay for heard in group.schedule.heard}) > 1
        places = (
            (p, k) for p, clock in enumerate(group.jacobians.kind.clocks) for k in range(len(clock.receives))
        )
        for way, channel in (pair for place in places for pair in group.schedule.ways(*place)):
            row = np.full(n, Fraction(0), dtype=object)
            for j, weight in enumerate(whole.coupling[way][i]):
                row[starts[j] : starts[j + 1]] += weight * sent[j].get((way.link, channel), 0)
            delay = int(timings[way.delay] / frame)
            late = f" {delay} frames late" if several else ""
            name = f"{group.name}.{way.operator}(others.{channel}){late}"
            heard[i, way, channel] = _Signal(name, delay, row)
    place_of = {key: place for place, key in enumerate(heard)}
    fast: list[_Signal] = []
    slow: list[_Signal] = []
    columns: tuple[list[int], list[int]] = [], []  # of the holds of all sites, side by side
    first = 0
    for i, group in enumerate(sites):
        kind, own = group.jacobians.kind, slice(starts[i], starts[i + 1])
        clocks = [partition.clock for partition in kind.clocks]
        for column, hold in enumerate(kind.holds, first):
            if group.schedule.acting[column - first] is None:
                continue
            p, name = clocks.index(hold.clock), f"{group.name}.{hold.name}"
            delay = int(timings[hold.delay] / period)
            pattern, tick = group.jacobians.pattern.ticks[p], group.exact.ticks[p]
            received = pattern.r[hold.output].any()
            if pattern.x[hold.output].any() or not received:
                row = np.full(n, Fraction(0), dtype=object)
                row[own] += tick.x[hold.output]
                fast.append(_Signal(f"{name} own" if received else name, delay, row))
                columns[0].append(column)
            if received:
                row = np.full(len(heard), Fraction(0), dtype=object)
                for k, weight in enumerate(tick.r[hold.output]):
                    row[[place_of[i, *pair] for pair in group.schedule.ways(p, k)]] += weight
                slow.append(_Signal(f"{name} received", delay, row))
                columns[1].append(column)
        first += len(kind.holds)

    def side_by_side(blocks: Iterable[Floats]) -> Floats:
        """Return the blocks [A B] (n_x, n_x + n_u) of the sites as one of all states and inputs."""
        split = [np.split(block, [len(block)], axis=1) for block in blocks]
        block_diag = load_pool("scipy.linalg").block_diag
        a, b = (block_diag(*listed) for listed in zip(*split, strict=True))
        return np.hstack([a, b[:, columns[0]], b[:, columns[1]]])

    known = {id(site.site): discretize(site.exact.a, site.exact.b, [period])[0] for site in sites}
    steps = [known[id(site.site)] for site in sites]
    return _OpenLoop(
        ratio=ratio,
        period=period,
        states=tuple(
            f"{group.name}.{state.name}" for group in sites for state in group.jacobians.kind.states
        ),
        fast=tuple(fast),
        slow=tuple(slow),
        heard=tuple(heard.values()),
        ab=side_by_side(np.hstack([site.site.a, site.site.b]) for site in sites),
        step=with_radius(
            side_by_side(value_of(step) for step in steps),
            side_by_side(radius_of(step) for step in steps),
        ),
    )


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
        late = [tick - item.delay for item in inputs]
        acting = [value(i, by if i < n_c else by // ratio) for i, by in enumerate(late)]
        course.append(RADII.multiply(loop.step, np.concatenate([course[-1], unit[:, acting]], axis=1)))
    waiting, outputs = [], []
    for i in range(len(inputs)):
        newest = ratio if i < n_c else 1
        columns = [value(i, newest - age) for age in range(1, loop.depths[i] + 1)]
        waiting.append(unit[:, np.array(columns, dtype=np.intp)])
    heard = RADII.multiply(rounded(_floats(loop.heard, n)), course[0])
    for row, (item, start) in enumerate(zip(loop.heard, starts[len(inputs) :], strict=False)):
        line = np.concatenate([heard[:, row : row + 1], unit[:, start : start + item.delay]], axis=1)
        waiting.append(line[:, : item.delay])
        outputs.append(line[:, item.delay :])
    moved = np.concatenate([*course[1:], *waiting], axis=1)
    seen = np.concatenate([*course[:-1], *outputs], axis=1)
    return FrameMap(moved[..., :size], moved[..., size:], seen[..., :size], seen[..., size:])


def _feedback(loop: _OpenLoop) -> Floats:
    """Return F_D: the forces of each tick of the samples there, and those of what is heard."""
    own = np.kron(np.eye(loop.ratio), _floats(loop.fast, len(loop.states)))
    return np.asarray(load_pool("scipy.linalg").block_diag(own, _floats(loop.slow, len(loop.heard))))


def _close(delayed: FrameMap, f: Floats) -> Matrix:
    """Return A_cl of eq. (20) with its radii."""
    size = delayed.p.shape[-1]
    feedback = InterconnectionMatrices(rounded(f), np.zeros((2, len(f), size)))
    return close([delayed], [feedback], StateLayout((0,), ("",) * size, {}), numbers=RADII).matrix


def _named(loop: _OpenLoop) -> PaperMethod:
    """Return every matrix with the names of its rows and columns."""
    n, ratio = len(loop.states), loop.ratio
    fast, slow = (tuple(replace(signal, delay=0) for signal in signals) for signals in (loop.fast, loop.slow))
    at_once = replace(loop, fast=fast, slow=slow, heard=tuple(replace(item, delay=0) for item in loop.heard))
    f, lifted, delayed = _feedback(loop), _lift(at_once), _lift(loop)
    closed = value_of(_close(delayed, f))
    ticks = [float(j * loop.period * 1000) for j in range(1 - ratio, ratio)]
    forces, received, heard = ([signal.name for signal in signals] for signals in (fast, slow, loop.heard))
    stacked = _timed(loop.states, ticks[:ratio])
    augmented = (*stacked, *_waiting_names(loop))
    inputs = (*_timed(forces, ticks[ratio - 1 :]), *received)
    outputs = (*_timed(loop.states, ticks[ratio - 1 :]), *heard)
    values = np.zeros(len(closed), dtype=np.complex128)
    alive = slice((ratio - 1) * n, None)  # the columns before are zero, and so are as many eigenvalues
    values[alive] = np.linalg.eigvals(closed[alive, alive])
    return PaperMethod(
        ratio=ratio,
        frame_s=loop.frame_s,
        a=NamedMatrix(loop.ab[:, :n], loop.states, loop.states),
        b=NamedMatrix(loop.ab[:, n:], loop.states, (*forces, *received)),
        c=NamedMatrix(np.vstack([np.eye(n), _floats(loop.heard, n)]), (*loop.states, *heard), loop.states),
        **_blocks("d", lifted, stacked, inputs, outputs),
        **_blocks("aug", delayed, augmented, inputs, outputs),
        f_d=NamedMatrix(f, inputs, outputs),
        closed=NamedMatrix(closed, augmented, augmented),
        eigenvalues=values[np.lexsort((-values.imag, values.real, -np.abs(values)))],
    )


def _blocks(
    suffix: str, lifted: FrameMap, states: tuple[str, ...], inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> dict[str, NamedMatrix]:
    """Return A, B, C and D of a lifted system by their names in `PaperMethod`."""
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
        f"{signal.name}({-age * float((loop.period if i < len(loop.fast) else frame) * 1000):.6g} ms)"
        for i, (signal, depth) in enumerate(zip(signals, loop.depths, strict=True))
        for age in range(1, depth + 1)
    )


# ---- the analysis: rigid motions out, then eigenvalues ----


def _without_rigid(loop: _OpenLoop, whole: ClosedLoop, rigid: RigidModes) -> ClosedLoop:
    """Return A_cl in relative coordinates, without its zero columns.

    As many positions are given up as there are rigid motions. Where x stands, so does all that is a form in
    it: what is still to act, and to be heard.
    """
    n, zero = len(loop.states), (loop.ratio - 1) * len(loop.states)
    closed = _close(_lift(loop), _feedback(loop))[..., zero:, zero:]
    motions = []
    for motion in rigid.exact:
        x = np.array([motion[place] for place in whole.motion], dtype=object)
        heard = _weights(loop.heard, n) @ x
        signals = [*(_weights(loop.fast, n) @ x), *(_weights(loop.slow, len(heard)) @ heard), *heard]
        motions.append([*x, *np.repeat(np.array(signals, dtype=object), loop.depths)])
    basis = np.array(motions, dtype=np.float64).reshape(len(motions), closed.shape[-1]).T
    held, _ = relative_places(basis[:n])
    rest = np.delete(np.arange(len(basis)), held)
    at = relative_coordinates(basis, (held, rest))
    matrix, error = relative_bounded(value_of(closed), radius_of(closed), at)
    names = (*loop.states, *_waiting_names(loop))
    return ClosedLoop(
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


def _periods(system: Model, sites: Sequence[PeerClass]) -> tuple[Fraction, Fraction]:
    """Return T_c and T_n, or say everything that keeps a scene from having the paper's form."""
    timings = {timing.name: timing.value for timing in system.timings}
    link_clock = {link.name: link.clock for link in system.links}
    holds = [
        hold
        for group in sites
        for hold, acting in zip(group.jacobians.kind.holds, group.schedule.acting, strict=True)
        if acting is not None
    ]
    ways = [heard.way for group in sites for heard in group.schedule.heard]
    forces = dict.fromkeys(hold.clock for hold in holds)
    networks = dict.fromkeys(link_clock[way.link] for way in ways)
    missing = [text for group in {id(site.site): site for site in sites}.values() for text in _misfits(group)]
    for what, result in (("clock of forces", forces), ("network clock", networks)):
        if len(result) != 1:
            listed = f"here are {' and '.join(result)}" if result else "here is none"
            missing.append(f"one {what} ({listed})")
    if missing:
        raise _not_of_the_form(system, missing)
    fast, slow = (
        next(clock for clock in system.clocks if clock.name in names) for names in (forces, networks)
    )
    period, frame = timings[fast.period], timings[slow.period]
    apart = timings[slow.phase] - timings[fast.phase]
    whole = [
        (frame / period, f"a network period that is a whole multiple of that of {fast.name}"),
        (apart / period, f"ticks of {slow.name} that fall on ticks of {fast.name}"),
    ]
    whole += [
        (timings[hold.delay] / period, f"a computational delay of {hold.name} of whole ticks of {fast.name}")
        for hold in holds
    ]
    whole += [
        (timings[way.delay] / frame, f"a delay of {way.link} of whole ticks of {slow.name}") for way in ways
    ]
    if missing := [wanted for number, wanted in whole if number.denominator != 1]:
        raise _not_of_the_form(system, missing)
    return period, frame


def _misfits(group: PeerClass) -> Iterator[str]:
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


def _not_of_the_form(system: Model, missing: Iterable[str]) -> ApcError:
    what = "the paper's route is written for another form of scene; missing: " + "; ".join(
        dict.fromkeys(missing)
    )
    return ApcError(Diagnostic("E861", SourceLocation(system.origin.topology), what, hint=_INSTEAD))
