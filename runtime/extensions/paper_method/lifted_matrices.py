"""The paper's method: cut at every force, lifted over a frame, delayed, closed again.

Takes: a `Model` of the paper's form: linear, at rest or translating, with one clock of forces and one network
clock at an integer multiple of its period.
Gives: `NamedMatrix`, `PaperMethod`, `paper_method`, `analyze_paper`.
Guarantees: every matrix names its rows and columns; the nonzero eigenvalues are those of the direct method. A
model of another form raises an error with the reasons.
Does not: split equal peers into modes, so that it costs (4nR)³ for n peers at ratio R.

Rakhsha and Constantinescu, eqs. (7) to (20), after Araki and Yamamoto (IEEE Trans. Automatic Control 31,
1986) and Fotoohi et al. (Int. J. Robotics Research 26, 2007). With x of all peers, u_c the part of a force
from its own peer's samples, u_n the part from the others' packets, and y_n the received values:

    dx/dt = A x + B (u_c, u_n),   y = (x, y_n) = C x                                           (18)

A force that has both parts counts as two inputs, through one column of B each. The blocks that follow are not
printed; these have the printed shapes. With R force ticks a frame:

    x_D = (x at the R force ticks up to the frame's start, the newest last)
    u_D = (u_c at the R force ticks of the frame, u_n),   y_D = (x at these ticks, y_n)
    x_D⁺ = A_D x_D + B_D u_D,   y_D = C_D x_D + D_D u_D                                        (19)
    u_D = F_D y_D,   A_cl = A_aug + B_aug F_D (I − D_aug F_D)⁻¹ C_aug                          (20)

The augmented state contains, after x_D, the forces not yet active and the y_n in transit. D_aug F_D is
nilpotent: a force moves later samples only. All matrices are computed with their radii (see
`lifting.interval_arithmetic`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, lifted_classes
from apc.analysis.methods import PAPER
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.discretize import discretize
from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    error_radius,
    rounded,
    value_of,
    with_error_radius,
)
from apc.lifting.lift import FrameMap
from apc.lifting.numeric_model import numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import limitations
from apc.result import Result
from apc.spectrum.interconnection import ClosedLoop, InterconnectionMatrices, StateLayout, interconnect
from apc.spectrum.modes import dense
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import relative_bounded, relative_coordinates, relative_indices
from apc.spectrum.rigid_modes import RigidModes, classify_neutral_modes, find_rigid_modes
from apc.spectrum.spectrum import Spectrum, solve_spectrum, up_to
from apc.support.threads import load_pool
from apc.timing.schedule import CouplingTerm
from apc.verdict import StabilityVerdict

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# The limit of rows of y_D: four dense matrices of that size already fill 100 MB.
MOST_ROWS = 1800

# The alternative for a model of another form.
_INSTEAD = "--method modes"


@dataclass(frozen=True, slots=True, eq=False)
class NamedMatrix(Result):
    """A matrix (rows, columns) with the names of its rows and columns."""

    shown_by = "apc.extensions.paper_method.paper_method_output:matrix"

    values: Floats
    rows: tuple[str, ...]
    columns: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and of columns."""
        return len(self.rows), len(self.columns)


@dataclass(frozen=True, slots=True, eq=False)
class PaperMethod(Result):
    """Every matrix of the paper's section III, for n peers and R force ticks in a frame (`ratio`).

    `a`, `b`, `c` are those of eq. (18); `a_d`, `b_d`, `c_d`, `d_d` of eq. (19), without delays; `a_aug` …
    `d_aug` the same with the delays; `f_d` is the feedback; `closed` is A_cl of eq. (20); `eigenvalues` are
    its eigenvalues by decreasing magnitude, with those of rigid modes.
    """

    shown_by = "apc.extensions.paper_method.paper_method_output:paper_method"

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


def paper_method(model: Model) -> PaperMethod:
    """Return the matrices of the paper's method.

    Parameters
    ----------
    model
        The compiled model, with the parameter values to analyse.

    Raises
    ------
    ApcError
        E861 a model that is not of the paper's form, with the differences; E862 matrices that would be too
        large; and the errors of an analysis.
    """
    with evaluating(model):
        return _named_matrices(_open_loop(model, dense(*lifted_classes(numeric_model(model)))))


def analyze_paper(model: Model) -> Analysis:
    """Return the stability analysis of a model by the paper's method.

    The rigid modes are removed by their known directions: the participation of modes is in relative
    coordinates, without the share of a translation.

    Parameters
    ----------
    model
        The compiled model, with the parameter values to analyse.

    Raises
    ------
    ApcError
        As for `paper_method`; E861 also for a model with a drift.
    """
    with evaluating(model):
        closed_loop = dense(*lifted_classes(numeric_model(model)))
        loop = _open_loop(model, closed_loop)
        rigid = find_rigid_modes(closed_loop)
        if rigid.drifts:
            raise _form_error(model, ["a topology without unbounded rigid-body motion"])
        spectrum = _with_phase_advance(
            solve_spectrum([_without_rigid(loop, closed_loop, rigid)]), solve_spectrum([closed_loop])
        )
    neutral_modes = classify_neutral_modes(closed_loop)
    zero, size = (loop.ratio - 1) * len(loop.states), loop.starts[-1]
    return Analysis(
        topology=model.name,
        peers=model.peers,
        frame_s=loop.frame_s,
        states_per_peer=-(-(size - zero) // model.peers),
        method=PAPER,
        verdict=(
            up_to(neutral_modes.translations, neutral_modes.rotations)
            if spectrum.verdict is StabilityVerdict.STABLE
            else spectrum.verdict
        ),
        stable=spectrum.stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        radius_excess=spectrum.radius_excess,
        rigid_modes=len(rigid.names),
        translations=neutral_modes.translations,
        rotations=neutral_modes.rotations,
        unobservable=neutral_modes.names,
        modes=spectrum.modes,
        linearized=False,
        notes=(
            f"A_cl is {size} × {size}; {zero} of its columns, and as many eigenvalues, are zero",
            *spectrum.notes,
        ),
        limitations=limitations(model),
    )


# ---- eq. (18): the loop cut open ----


@dataclass(frozen=True, slots=True, eq=False)
class _Signal:
    """The exact weights of an input, or of a received value, and its delay.

    An input is over x (own samples) or over y_n (received values), a received value over x. The delay of an
    input is in force ticks, that of a received value in frames.
    """

    name: str
    delay: int
    weights: Matrix  # of `Fraction`


@dataclass(frozen=True, slots=True, eq=False)
class _OpenLoopMatrices:
    """The matrices of equation (18) with inputs and received values, for `ratio` force ticks per frame.

    `step` is [F G_c G_n] over one force period.
    """

    ratio: int
    period: Fraction  # s
    states: tuple[str, ...]
    fast: tuple[_Signal, ...]  # u_c, over x
    slow: tuple[_Signal, ...]  # u_n, over y_n
    received: tuple[_Signal, ...]  # y_n, over x
    ab: Floats  # [A B] (n, n + n_u)
    step: Matrix  # (2, n, n + n_u), with its radii

    @property
    def frame_s(self) -> float:
        """The length of a frame in seconds."""
        return float(self.ratio * self.period)

    @property
    def depths(self) -> list[int]:
        """The numbers of values in transit at a frame's start: of each input, then of each received value."""
        frames = [-(-item.delay // self.ratio) for item in self.slow]
        return [item.delay for item in self.fast] + frames + [item.delay for item in self.received]

    @property
    def starts(self) -> list[int]:
        """The first index of each signal's values in transit in the augmented state, then the
        state's size.
        """
        first = self.ratio * len(self.states)
        return list(itertools.accumulate(self.depths, initial=first))


def _weights(signals: Sequence[_Signal], width: int) -> Matrix:
    """Return the exact weights of signals (len(signals), width)."""
    return np.array([signal.weights for signal in signals], dtype=object).reshape(len(signals), width)


def _floats(signals: Sequence[_Signal], width: int) -> Floats:
    """Return the weights of signals (len(signals), width), each rounded once."""
    return _weights(signals, width).astype(np.float64)


def _open_loop(model: Model, closed_loop: ClosedLoop) -> _OpenLoopMatrices:
    """Return the matrices of the model of all peers, cut open at every force."""
    peer_classes = closed_loop.peer_classes
    period, frame = _periods(model, peer_classes)
    ratio = int(frame / period)
    timings = {timing.name: timing.value for timing in model.timings}
    starts = [
        0,
        *itertools.accumulate(len(peer_class.jacobians.peer_type.states) for peer_class in peer_classes),
    ]
    n = starts[-1]
    if (n + 2 * len(peer_classes)) * ratio > MOST_ROWS:
        message = (
            f"the paper's matrices for {len(peer_classes)} peers at {ratio} force ticks a frame have more "
            f"than {MOST_ROWS:,} rows"
        )
        raise ApcError(Diagnostic("E862", SourceLocation(model.origin.topology), message, fix=_INSTEAD))
    sent = [
        {
            (sending.link, channel): row
            for sending, send in zip(
                peer_class.jacobians.peer_type.sends, peer_class.exact.sends, strict=True
            )
            for channel, row in zip(sending.channels, send.x, strict=True)
        }
        for peer_class in peer_classes
    ]
    received: dict[tuple[int, CouplingTerm, str], _Signal] = {}
    for i, peer_class in enumerate(peer_classes):
        several_delays = len({received.coupling_term.delay for received in peer_class.schedule.received}) > 1
        indices = (
            (p, k)
            for p, clock in enumerate(peer_class.jacobians.peer_type.clocks)
            for k in range(len(clock.receives))
        )
        for coupling_term, channel in (
            pair for index in indices for pair in peer_class.schedule.coupling_terms(*index)
        ):
            row = np.full(n, Fraction(0), dtype=object)
            for j, weight in enumerate(closed_loop.coupling[coupling_term][i]):
                row[starts[j] : starts[j + 1]] += weight * sent[j].get((coupling_term.link, channel), 0)
            delay = int(timings[coupling_term.delay] / frame)
            delay_text = f" {delay} frames late" if several_delays else ""
            name = f"{peer_class.name}.{coupling_term.operator}(others.{channel}){delay_text}"
            received[i, coupling_term, channel] = _Signal(name, delay, row)
    index_of = {key: index for index, key in enumerate(received)}
    fast: list[_Signal] = []
    slow: list[_Signal] = []
    columns: tuple[list[int], list[int]] = [], []  # indices of holds, over all subsystems
    first = 0
    for i, peer_class in enumerate(peer_classes):
        peer_type, own_states = peer_class.jacobians.peer_type, slice(starts[i], starts[i + 1])
        clocks = [partition.clock for partition in peer_type.clocks]
        for column, hold in enumerate(peer_type.holds, first):
            if peer_class.schedule.active_at_start[column - first] is None:
                continue
            p, name = clocks.index(hold.clock), f"{peer_class.name}.{hold.name}"
            delay = int(timings[hold.delay] / period)
            pattern, tick = peer_class.jacobians.pattern.ticks[p], peer_class.exact.ticks[p]
            input_rows = pattern.r[hold.output].any()
            if pattern.x[hold.output].any() or not input_rows:
                row = np.full(n, Fraction(0), dtype=object)
                row[own_states] += tick.x[hold.output]
                fast.append(_Signal(f"{name} own" if input_rows else name, delay, row))
                columns[0].append(column)
            if input_rows:
                row = np.full(len(received), Fraction(0), dtype=object)
                for k, weight in enumerate(tick.r[hold.output]):
                    row[[index_of[i, *pair] for pair in peer_class.schedule.coupling_terms(p, k)]] += weight
                slow.append(_Signal(f"{name} received", delay, row))
                columns[1].append(column)
        first += len(peer_type.holds)

    def side_by_side(blocks: Iterable[Floats]) -> Floats:
        """Return the blocks [A B] (n_x, n_x + n_u) of the subsystems as one matrix over all states and
        inputs.
        """
        split = [np.split(block, [len(block)], axis=1) for block in blocks]
        block_diag = load_pool("scipy.linalg").block_diag
        a, b = (block_diag(*blocks_of_kind) for blocks_of_kind in zip(*split, strict=True))
        return np.hstack([a, b[:, columns[0]], b[:, columns[1]]])

    steps_of_class = {
        peer_class.index: discretize(peer_class.exact.a, peer_class.exact.b, [period])[0]
        for peer_class in peer_classes
    }
    steps = [steps_of_class[peer_class.index] for peer_class in peer_classes]
    return _OpenLoopMatrices(
        ratio=ratio,
        period=period,
        states=tuple(
            f"{peer_class.name}.{state.name}"
            for peer_class in peer_classes
            for state in peer_class.jacobians.peer_type.states
        ),
        fast=tuple(fast),
        slow=tuple(slow),
        received=tuple(received.values()),
        ab=side_by_side(
            np.hstack([peer_class.subsystem.a, peer_class.subsystem.b]) for peer_class in peer_classes
        ),
        step=with_error_radius(
            side_by_side(value_of(step) for step in steps),
            side_by_side(error_radius(step) for step in steps),
        ),
    )


# ---- eqs. (19) and (20): lifted, delayed, closed ----


def _lift(loop: _OpenLoopMatrices) -> FrameMap:
    """Return the frame map A_aug, B_aug, C_aug and D_aug with radii, composed of the force ticks of
    a frame.
    """
    n, n_c, ratio, starts = len(loop.states), len(loop.fast), loop.ratio, loop.starts
    inputs = (*loop.fast, *loop.slow)
    state_size, forces = starts[-1], ratio * n_c + len(loop.slow)
    # Rows over the augmented state and u_D.
    unit = MIDPOINT_RADIUS.exact(np.eye(state_size + forces))

    def column_of(i: int, tick_index: int) -> int:
        """Return the column of the value of input i at index `number` of the frame.

        The index is negative for earlier frames.
        """
        if tick_index < 0:
            return starts[i] - tick_index - 1
        return state_size + (tick_index * n_c + i if i < n_c else ratio * n_c + i - n_c)

    states_at_ticks = [unit[:, (ratio - 1) * n : ratio * n]]
    for tick in range(ratio):
        delayed_indices = [tick - item.delay for item in inputs]
        active_columns = [
            column_of(i, delayed_index if i < n_c else delayed_index // ratio)
            for i, delayed_index in enumerate(delayed_indices)
        ]
        states_at_ticks.append(
            MIDPOINT_RADIUS.multiply(
                loop.step, np.concatenate([states_at_ticks[-1], unit[:, active_columns]], axis=1)
            )
        )
    next_in_transit, outputs = [], []
    for i in range(len(inputs)):
        count = ratio if i < n_c else 1
        columns = [column_of(i, count - age) for age in range(1, loop.depths[i] + 1)]
        next_in_transit.append(unit[:, np.array(columns, dtype=np.intp)])
    received = MIDPOINT_RADIUS.multiply(rounded(_floats(loop.received, n)), states_at_ticks[0])
    for row, (item, start) in enumerate(zip(loop.received, starts[len(inputs) :], strict=False)):
        line = np.concatenate([received[:, row : row + 1], unit[:, start : start + item.delay]], axis=1)
        next_in_transit.append(line[:, : item.delay])
        outputs.append(line[:, item.delay :])
    next_rows = np.concatenate([*states_at_ticks[1:], *next_in_transit], axis=1)
    output_rows = np.concatenate([*states_at_ticks[:-1], *outputs], axis=1)
    return FrameMap(
        next_rows[..., :state_size],
        next_rows[..., state_size:],
        output_rows[..., :state_size],
        output_rows[..., state_size:],
    )


def _feedback(loop: _OpenLoopMatrices) -> Floats:
    """Return F_D: the forces of each tick from the samples at this tick, and the forces from received
    values.
    """
    own_feedback = np.kron(np.eye(loop.ratio), _floats(loop.fast, len(loop.states)))
    return np.asarray(
        load_pool("scipy.linalg").block_diag(own_feedback, _floats(loop.slow, len(loop.received)))
    )


def _close(delayed: FrameMap, f: Floats) -> Matrix:
    """Return A_cl of eq. (20), the closed loop over the augmented state, with its radii."""
    size = delayed.p.shape[-1]
    feedback = InterconnectionMatrices(rounded(f), np.zeros((2, len(f), size)))
    return interconnect(
        [delayed], [feedback], StateLayout((0,), ("",) * size, {}), numbers=MIDPOINT_RADIUS
    ).matrix


def _named_matrices(loop: _OpenLoopMatrices) -> PaperMethod:
    """Return every matrix of the method with the names of its rows and columns."""
    n, ratio = len(loop.states), loop.ratio
    fast, slow = (tuple(replace(signal, delay=0) for signal in signals) for signals in (loop.fast, loop.slow))
    without_delays = replace(
        loop, fast=fast, slow=slow, received=tuple(replace(item, delay=0) for item in loop.received)
    )
    f, lifted, delayed = _feedback(loop), _lift(without_delays), _lift(loop)
    closed = value_of(_close(delayed, f))
    ticks = [float(j * loop.period * 1000) for j in range(1 - ratio, ratio)]
    forces, input_rows, received = (
        [signal.name for signal in signals] for signals in (fast, slow, loop.received)
    )
    stacked = _names_at_times(loop.states, ticks[:ratio])
    augmented = (*stacked, *_delayed_names(loop))
    inputs = (*_names_at_times(forces, ticks[ratio - 1 :]), *input_rows)
    outputs = (*_names_at_times(loop.states, ticks[ratio - 1 :]), *received)
    values = np.zeros(len(closed), dtype=np.complex128)
    nonzero_part = slice(
        (ratio - 1) * n, None
    )  # the columns before are zero, and so is the same number of eigenvalues
    values[nonzero_part] = np.linalg.eigvals(closed[nonzero_part, nonzero_part])
    return PaperMethod(
        ratio=ratio,
        frame_s=loop.frame_s,
        a=NamedMatrix(loop.ab[:, :n], loop.states, loop.states),
        b=NamedMatrix(loop.ab[:, n:], loop.states, (*forces, *input_rows)),
        c=NamedMatrix(
            np.vstack([np.eye(n), _floats(loop.received, n)]), (*loop.states, *received), loop.states
        ),
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


def _names_at_times(names: Sequence[str], times: Sequence[float]) -> tuple[str, ...]:
    """Return every name at every time, in ms: `user[1].cube.x(-1 ms)`."""
    return tuple(f"{name}({time:.6g} ms)" for time in times for name in names)


def _delayed_names(loop: _OpenLoopMatrices) -> tuple[str, ...]:
    """Return the names of the augmented states after x_D: forces not yet active, and y_n in transit."""
    frame = loop.ratio * loop.period
    signals = (*loop.fast, *loop.slow, *loop.received)
    return tuple(
        f"{signal.name}({-age * float((loop.period if i < len(loop.fast) else frame) * 1000):.6g} ms)"
        for i, (signal, depth) in enumerate(zip(signals, loop.depths, strict=True))
        for age in range(1, depth + 1)
    )


# ---- the analysis: rigid motions out, then eigenvalues ----


def _without_rigid(loop: _OpenLoopMatrices, closed_loop: ClosedLoop, rigid: RigidModes) -> ClosedLoop:
    """Return the closed loop in relative coordinates, its zero columns and rigid modes removed.

    As many positions are eliminated as there are rigid modes. The directions of the rigid modes are extended
    from x to the forces not yet active and the values in transit, which are constant with x.
    """
    n, zero_columns = len(loop.states), (loop.ratio - 1) * len(loop.states)
    closed = _close(_lift(loop), _feedback(loop))[..., zero_columns:, zero_columns:]
    directions = []
    for direction in rigid.exact:
        x = np.array([direction[index] for index in closed_loop.motion], dtype=object)
        received = _weights(loop.received, n) @ x
        signals = [*(_weights(loop.fast, n) @ x), *(_weights(loop.slow, len(received)) @ received), *received]
        directions.append([*x, *np.repeat(np.array(signals, dtype=object), loop.depths)])
    basis = np.array(directions, dtype=np.float64).reshape(len(directions), closed.shape[-1]).T
    eliminated, _ = relative_indices(basis[:n])
    remaining = np.delete(np.arange(len(basis)), eliminated)
    coordinates = relative_coordinates(basis, (eliminated, remaining))
    matrix, error = relative_bounded(value_of(closed), error_radius(closed), coordinates)
    names = (*loop.states, *_delayed_names(loop))
    return ClosedLoop(
        name=PAPER,
        multiplicity=1,
        peer_classes=(),  # a separate matrix, its rigid modes already removed
        coupling={},
        frame_s=loop.frame_s,
        layout=StateLayout((0,), tuple(names[index] for index in remaining), {}),
        matrix=matrix,
        error=error,
        received=(),
        motion=tuple(range(n - len(eliminated))),
    )


def _with_phase_advance(spectrum: Spectrum, direct: Spectrum) -> Spectrum:
    """Return a spectrum whose frequencies are those of the direct method's equal eigenvalues.

    The lifted matrices contain the ticks of a frame only: complete turns between ticks are counted by the
    direct method.
    """
    values = np.array([mode.eigenvalue for mode in direct.modes])
    modes = []
    for mode in spectrum.modes:
        if np.isnan(mode.frequency_hz):
            nearest = direct.modes[int(np.argmin(np.abs(values - mode.eigenvalue)))]
            if abs(nearest.eigenvalue - mode.eigenvalue) <= nearest.error + mode.error:
                motion = replace(nearest.motion[0], participation=mode.participation)
                mode = replace(mode, motion=(motion,))
        modes.append(mode)
    return replace(spectrum, modes=tuple(modes))


# ---- the paper's form ----


def _periods(model: Model, peer_classes: Sequence[PeerClass]) -> tuple[Fraction, Fraction]:
    """Return the periods T_c and T_n in seconds.

    An error with all differences if the form is not the paper's.
    """
    timings = {timing.name: timing.value for timing in model.timings}
    link_clock = {link.name: link.clock for link in model.links}
    holds = [
        hold
        for peer_class in peer_classes
        for hold, active_at_start in zip(
            peer_class.jacobians.peer_type.holds, peer_class.schedule.active_at_start, strict=True
        )
        if active_at_start is not None
    ]
    coupling_terms = [
        received.coupling_term for peer_class in peer_classes for received in peer_class.schedule.received
    ]
    forces = dict.fromkeys(hold.clock for hold in holds)
    networks = dict.fromkeys(term.clock or link_clock[term.link] for term in coupling_terms)
    missing = [
        text
        for peer_class in {peer_class.index: peer_class for peer_class in peer_classes}.values()
        for text in _form_differences(peer_class)
    ]
    if any(link.after for link in model.links):
        missing.append("packets that take the values before the ticks (order: before)")
    for subject, result in (("clock of forces", forces), ("network clock", networks)):
        if len(result) != 1:
            listed = f"got {' and '.join(result) or 'none'}"
            missing.append(f"one {subject} ({listed})")
    if missing:
        raise _form_error(model, missing)
    fast, slow = (
        next(clock for clock in model.clocks if clock.name in names) for names in (forces, networks)
    )
    period, frame = timings[fast.period], timings[slow.period]
    separation = timings[slow.phase] - timings[fast.phase]
    quotients = [
        (frame / period, f"a network period that is a whole multiple of that of {fast.name}"),
        (separation / period, f"ticks of {slow.name} that fall on ticks of {fast.name}"),
    ]
    quotients += [
        (timings[hold.delay] / period, f"a computational delay of {hold.name} of whole ticks of {fast.name}")
        for hold in holds
    ]
    quotients += [
        (
            timings[coupling_term.delay] / frame,
            f"a delay of {coupling_term.link} of whole ticks of {slow.name}",
        )
        for coupling_term in coupling_terms
    ]
    if missing := [requirement for quotient, requirement in quotients if quotient.denominator != 1]:
        raise _form_error(model, missing)
    return period, frame


def _form_differences(peer_class: PeerClass) -> Iterator[str]:
    """Yield the properties of the paper's form that a peer's own equations do not have."""
    peer_type, pattern = peer_class.jacobians.peer_type, peer_class.jacobians.pattern
    if not peer_class.subsystem.affine:
        yield f"linear equations ({peer_type.name} is not linear)"
    for partition, tick in zip(peer_type.clocks, pattern.ticks, strict=True):
        if partition.variants:
            yield "forces with the same equation at every tick (they depend on the age of received data)"
        if any(receive.before for receive in partition.receives):
            yield "forces of the current samples only (they also depend on the previous tick)"
        if tick.m.any():
            names = [partition.outputs[partition.memories[m]] for m in np.flatnonzero(tick.m.any(axis=0))]
            yield f"forces of the current samples only ({', '.join(names)} is stored between ticks)"
        if tick.u.any():
            yield f"forces of the current samples only (at ticks of {partition.clock}, a held force is used)"
    if any(send.u.any() for send in pattern.sends):
        yield "packets with positions and velocities only (a held force is sent)"


def _form_error(model: Model, missing: Iterable[str]) -> ApcError:
    """Return the error E861 with the missing properties of the paper's form."""
    message = "method paper does not apply to this topology; missing: " + "; ".join(dict.fromkeys(missing))
    return ApcError(Diagnostic("E861", SourceLocation(model.origin.topology), message, fix=_INSTEAD))
