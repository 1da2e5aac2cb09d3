"""The analysis as the paper writes it: cut at every force, lifted over a frame, delayed, closed again.

Takes: a `CompiledSystem` of the paper's form (see `openloop`).
Gives: `NamedMatrix`, `PaperRoute`, `paper_route`, `analyze_paper`.
Guarantees: every matrix names its rows and columns; the nonzero eigenvalues are those of the direct route.
Does not: split equal peers into modes, so it costs (4nR)³ for n peers at ratio R.

Rakhsha and Constantinescu, eqs. (18) to (20), after Araki and Yamamoto (IEEE Trans. Automatic Control 31,
1986) and Fotoohi et al. (Int. J. Robotics Research 26, 2007). The blocks are not printed; these have the
printed shapes. With R force ticks a frame:

    x_D = (x at the R force ticks up to the frame's start, the newest last)
    u_D = (u_c at the R force ticks of the frame, u_n),   y_D = (x at these ticks, y_n)
    x_D⁺ = A_D x_D + B_D u_D,   y_D = C_D x_D + D_D u_D                                        (19)
    u_D = F_D y_D,   A_cl = A_aug + B_aug F_D (I − D_aug F_D)⁻¹ C_aug                          (20)

The augmented state holds, after x_D, the forces still to act and the y_n still to arrive. D_aug F_D is
nilpotent: a force moves later samples only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis
from apc.analysis.methods import PAPER
from apc.analysis.openloop import Input, OpenLoop, open_loop, over, whole_system
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import ClosedSystem, Feedback, StateLayout, close
from apc.eigen.relative import Relative, independent_places, relative_bounded
from apc.eigen.rigid import RigidModes, find_rigid_modes
from apc.eigen.spectrum import DRIFTS, STABLE, STABLE_TRANSLATING, Spectrum, solve_spectrum
from apc.finite_equations import finite_equations
from apc.frame.discretize import COEFFICIENT_ROUNDINGS, UNIT
from apc.frame.lift import FrameMap
from apc.network.nominal import left_out
from apc.result import Result
from apc.threads import single_threaded

Floats = NDArray[np.float64]

# Rounding of a standing state from exact numbers, of its pivots' inverse and of the product of both, in units
# of UNIT: a few operations an entry, of as many terms as there are rigid motions.
RIGID_ROUNDINGS = 16


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
        return _route(open_loop(system, whole_system(system)))


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
        As `paper_route`.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        whole = whole_system(system)
        loop = open_loop(system, whole)
        rigid = find_rigid_modes(whole)
        closed, dead = _without_rigid(loop, whole, rigid)
        spectrum = _with_rigid(_with_turns(solve_spectrum([closed]), solve_spectrum([whole])), rigid)
    size = dead + len(closed.names) + rigid.basis.shape[1]
    return Analysis(
        topology=system.name,
        peers=system.peers,
        frame_s=closed.frame_s,
        states_per_peer=-(-(size - dead) // system.peers),
        method=PAPER,
        verdict=spectrum.verdict,
        stable=spectrum.stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        rigid_modes=spectrum.rigid_modes,
        translations=spectrum.rigid_modes,
        modes=spectrum.modes,
        linearized=False,
        notes=(
            f"A_cl is {size} × {size}; {dead} of its columns are zero and as many eigenvalues with them",
            *spectrum.notes,
        ),
        left_out=left_out(system),
    )


def _sizes(loop: OpenLoop) -> tuple[int, int, int, int, int]:
    """Return the numbers of states, fast inputs, slow inputs and rows of y_n, and the ratio."""
    return len(loop.states), len(loop.fast), len(loop.slow), len(loop.heard), loop.ratio


# ---- eqs. (19) and (20): lifted, delayed, closed ----


@dataclass(frozen=True, slots=True, eq=False)
class _Lifted:
    """Eq. (19), and the same with delays; `terms` is the most terms of any sum in their products."""

    plain: tuple[Floats, Floats, Floats, Floats]
    delayed: tuple[Floats, Floats, Floats, Floats]
    f: Floats
    terms: int


def _lift(loop: OpenLoop, step: Floats, absolute: bool = False) -> _Lifted:
    """Stack the open loop over a frame, delay it, and write its feedback; or all of it in magnitudes."""
    n, n_c, n_s, n_h, ratio = _sizes(loop)
    size = np.abs if absolute else (lambda values: values)
    advance, force = step[:, :n], step[:, n:]
    # Rows: x at ticks 0 … R of the frame. Columns: x at its start, then what acts tick by tick (fast, slow).
    course = np.zeros(((ratio + 1) * n, n + ratio * (n_c + n_s)))
    course[:n, :n] = np.eye(n)
    for j in range(ratio):
        now, following = slice(j * n, (j + 1) * n), slice((j + 1) * n, (j + 2) * n)
        course[following] = advance @ course[now]
        at = n + j * (n_c + n_s)
        course[following, at : at + n_c + n_s] = force
    newest = np.zeros((n, ratio * n))
    newest[:, -n:] = np.eye(n)
    c_n = size(loop.c_n)
    a_d, b_all = course[n:, :n] @ newest, course[n:, n:]
    c_d = np.vstack([course[:-n, :n] @ newest, c_n @ newest])
    d_all = np.vstack([course[:-n, n:], np.zeros((n_h, ratio * (n_c + n_s)))])

    at_once, _, _ = _acting(replace(loop, fast=_undelayed(loop.fast), slow=_undelayed(loop.slow)))
    from_inputs, from_state, shift = _acting(loop)
    waiting = sum(one.delay for one in loop.heard)
    a_aug = np.zeros((ratio * n + len(shift[0]) + waiting,) * 2)
    forces = slice(ratio * n, ratio * n + len(shift[0]))
    a_aug[: ratio * n, : ratio * n] = a_d
    a_aug[: ratio * n, forces] = b_all @ from_state
    a_aug[forces, forces] = shift[0]
    c_aug = np.zeros((len(c_d), len(a_aug)))
    c_aug[:, : ratio * n] = c_d
    c_aug[:, forces] = d_all @ from_state
    at = forces.stop
    for row, one in enumerate(loop.heard):
        line = ratio * n + row
        for age in range(one.delay):
            if age == 0:
                a_aug[at] = c_aug[line]
            else:
                a_aug[at + age, at + age - 1] = 1.0
        if one.delay:
            c_aug[line] = 0.0
            c_aug[line, at + one.delay - 1] = 1.0
        at += one.delay
    b_aug = np.vstack([b_all @ from_inputs, shift[1], np.zeros((waiting, ratio * n_c + n_s))])
    f = np.zeros((ratio * n_c + n_s, ratio * n + n_h))
    own = size(over([one.terms for one in loop.fast], n))
    for j in range(ratio):
        f[j * n_c : (j + 1) * n_c, j * n : (j + 1) * n] = own
    f[ratio * n_c :, ratio * n :] = size(over([one.terms for one in loop.slow], n_h))
    delayed = (a_aug, b_aug, c_aug, d_all @ from_inputs)
    terms = max(int(np.count_nonzero(one, axis=1).max(initial=0)) for one in (*delayed, f, step))
    return _Lifted((a_d, b_all @ at_once, c_d, d_all @ at_once), delayed, f, terms)


def _close(lifted: _Lifted) -> Floats:
    """Return A_cl of eq. (20): the loop u_D = F_D y_D closed; what is on its way is in the state."""
    one = FrameMap(*lifted.delayed)
    names = ("",) * len(one.p)
    feedback = Feedback(lifted.f, np.zeros((len(lifted.f), len(one.p))))
    return close([one], [feedback], StateLayout((0,), names, {})).matrix


def _acting(loop: OpenLoop) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """Return what acts tick by tick over (u_D) and over the waiting forces, and how these move on.

    The waiting forces are, input by input, the newest first: of a fast one its values at the last ticks
    before the frame, of a slow one those of the last frames.
    """
    n_c, n_s, ratio = len(loop.fast), len(loop.slow), loop.ratio
    depths = [one.delay for one in loop.fast] + [-(-one.delay // ratio) for one in loop.slow]
    starts = np.cumsum([0, *depths]).tolist()
    from_inputs = np.zeros((ratio * (n_c + n_s), ratio * n_c + n_s))
    from_state = np.zeros((len(from_inputs), starts[-1]))
    kept = np.zeros((starts[-1], starts[-1])), np.zeros((starts[-1], ratio * n_c + n_s))
    for i, one in enumerate((*loop.fast, *loop.slow)):
        fast = i < n_c
        per_frame = ratio if fast else 1  # how often it is computed in a frame
        for j in range(ratio):
            number = j - one.delay if fast else (j - one.delay) // ratio
            row = j * (n_c + n_s) + i
            if number >= 0:
                from_inputs[row, number * n_c + i if fast else ratio * n_c + i - n_c] = 1.0
            else:
                from_state[row, starts[i] - number - 1] = 1.0
        for age in range(1, depths[i] + 1):  # at the next frame's start
            number = per_frame - age
            if number >= 0:
                kept[1][starts[i] + age - 1, number * n_c + i if fast else ratio * n_c + i - n_c] = 1.0
            else:
                kept[0][starts[i] + age - 1, starts[i] - number - 1] = 1.0
    return from_inputs, from_state, kept


def _undelayed(inputs: Sequence[Input]) -> tuple[Input, ...]:
    return tuple(replace(one, delay=0) for one in inputs)


def _route(loop: OpenLoop) -> PaperRoute:
    """Name every matrix."""
    n, _, _, _, ratio = _sizes(loop)
    lifted = _lift(loop, loop.step)
    closed = _close(lifted)
    times = [float(j * loop.period * 1000) for j in range(-ratio, ratio)]
    fast, slow = [one.name for one in loop.fast], [one.name for one in loop.slow]
    heard = [one.name for one in loop.heard]
    stacked = _timed(loop.states, times[1 : ratio + 1])
    inputs, outputs = (*_timed(fast, times[ratio:]), *slow), (*_timed(loop.states, times[ratio:]), *heard)
    waiting = _waiting_names(loop)
    augmented = (*stacked, *waiting)
    a_d, b_d, c_d, d_d = lifted.plain
    a_aug, b_aug, c_aug, d_aug = lifted.delayed
    values = np.zeros(len(closed), dtype=np.complex128)
    alive = slice((ratio - 1) * n, None)  # the columns before are zero, and so are as many eigenvalues
    values[alive] = np.linalg.eigvals(closed[alive, alive])
    return PaperRoute(
        ratio=ratio,
        frame_s=float(ratio * loop.period),
        a=NamedMatrix(loop.a, loop.states, loop.states),
        b=NamedMatrix(loop.b, loop.states, (*fast, *slow)),
        c=NamedMatrix(np.vstack([np.eye(n), loop.c_n]), (*loop.states, *heard), loop.states),
        a_d=NamedMatrix(a_d, stacked, stacked),
        b_d=NamedMatrix(b_d, stacked, inputs),
        c_d=NamedMatrix(c_d, outputs, stacked),
        d_d=NamedMatrix(d_d, outputs, inputs),
        a_aug=NamedMatrix(a_aug, augmented, augmented),
        b_aug=NamedMatrix(b_aug, augmented, inputs),
        c_aug=NamedMatrix(c_aug, outputs, augmented),
        d_aug=NamedMatrix(d_aug, outputs, inputs),
        f_d=NamedMatrix(lifted.f, inputs, outputs),
        closed=NamedMatrix(closed, augmented, augmented),
        eigenvalues=values[np.lexsort((-values.imag, values.real, -np.abs(values)))],
    )


def _timed(names: Sequence[str], times: Sequence[float]) -> tuple[str, ...]:
    """Return every name at every time, in ms: `user[1].cube.x(-1 ms)`."""
    return tuple(f"{name}({time:.6g} ms)" for time in times for name in names)


def _waiting_names(loop: OpenLoop) -> tuple[str, ...]:
    """Return the names of the augmented states: forces still to act, and what is still to be heard."""
    period, frame = float(loop.period * 1000), float(loop.ratio * loop.period * 1000)
    names = [f"{one.name}({-age * period:.6g} ms)" for one in loop.fast for age in range(1, one.delay + 1)]
    for one in loop.slow:
        names += [f"{one.name}({-age * frame:.6g} ms)" for age in range(1, -(-one.delay // loop.ratio) + 1)]
    for row in loop.heard:
        names += [f"{row.name}({-age * frame:.6g} ms)" for age in range(1, row.delay + 1)]
    return tuple(names)


# ---- the analysis: rigid motions out, then eigenvalues ----


def _without_rigid(loop: OpenLoop, whole: ClosedSystem, rigid: RigidModes) -> tuple[ClosedSystem, int]:
    """Return A_cl in relative coordinates, its error and its motion; and how many zero columns were left out.

    As many positions are given up as there are rigid motions.
    """
    n, _, _, _, ratio = _sizes(loop)
    lifted, large = _lift(loop, loop.step), _lift(loop, loop.step_size, absolute=True)
    dead = (ratio - 1) * n
    closed, size = _close(lifted), _close(large)
    # A path through a frame passes at most so many sums and coefficients (see `lift.lift`).
    roundings = (3 * ratio + 4) * (lifted.terms + 2 + COEFFICIENT_ROUNDINGS)
    charge = roundings * UNIT / (1 - roundings * UNIT)
    matrix, size = closed[dead:, dead:], size[dead:, dead:]
    names = (*loop.states, *_waiting_names(loop))
    error = charge * size
    rest = np.arange(len(matrix))
    basis, doubt = _rigid_basis(loop, whole, rigid)
    moving = rest[:n]
    if basis.shape[1]:
        held = independent_places(basis[:n].T)
        rest = np.delete(rest, held)
        moving = rest[rest < n]
        inverse = np.linalg.inv(basis[held])
        weights = basis[rest] @ inverse
        # W off: by V_r's error, by V_p's through W, by the rounding of the inverse and of the product.
        wrong = RIGID_ROUNDINGS * basis.shape[1] * UNIT
        wide = np.abs(basis[rest]) @ np.abs(inverse)
        off = doubt[rest] @ np.abs(inverse)
        off += wide @ (doubt[held] + wrong * np.abs(basis[held])) @ np.abs(inverse) + wrong * wide
        at = Relative(held, rest, weights, 2 * off + wrong * np.abs(weights))
        matrix, error = relative_bounded(matrix, error, at)
    system = ClosedSystem(
        name=PAPER,
        multiplicity=1,
        sites=(),  # a matrix by itself, its rigid motions already out
        coupling={},
        frame_s=float(ratio * loop.period),
        layout=StateLayout((0,), tuple(names[place] for place in rest), {}),
        matrix=matrix,
        error=error,
        heard=(),
        motion=tuple(range(len(moving))),
    )
    return system, dead


def _rigid_basis(loop: OpenLoop, whole: ClosedSystem, rigid: RigidModes) -> tuple[Floats, Floats]:
    """Return the rigid motions over the augmented state, and bounds on their errors.

    Everything in the state is a form in x, each of its terms at some time, so a motion of x is one of the
    state: standing, x = x₀; drifting, x(t) = x₁ + t x₀.
    """
    n, _, _, _, ratio = _sizes(loop)
    frame = float(ratio * loop.period)
    fast = over([one.terms for one in loop.fast], n)
    heard_at = np.array([-one.delay * frame for one in loop.heard])
    forms, timed = [np.eye(n)], [np.zeros((n, n))]  # a form, and the same with each term times its time
    for one, form in zip(loop.fast, fast, strict=True):
        for age in range(1, one.delay + 1):
            forms.append(form[None, :])
            timed.append(-age * float(loop.period) * form[None, :])
    for one, weights in zip(loop.slow, over([one.terms for one in loop.slow], len(heard_at)), strict=True):
        for age in range(1, -(-one.delay // ratio) + 1):
            forms.append(weights[None, :] @ loop.c_n)
            timed.append((weights * (heard_at - age * frame))[None, :] @ loop.c_n)
    for row, one_heard in enumerate(loop.heard):
        for age in range(1, one_heard.delay + 1):
            forms.append(loop.c_n[[row]])
            timed.append(-age * frame * loop.c_n[[row]])
    form, late = np.vstack(forms), np.vstack(timed)
    motion = list(whole.motion)
    standing, second = rigid.directions[motion], rigid.generalized[motion]
    # What a drift gains in a frame is a standing motion: M x₁ = x₁ + T x₀.
    inverse = np.linalg.pinv(standing)
    gained = (whole.matrix @ rigid.generalized - rigid.generalized)[motion] / frame
    shares = inverse @ gained
    size = (whole.error + RIGID_ROUNDINGS * UNIT * np.abs(whole.matrix)) @ np.abs(rigid.generalized)
    unsure = 2 * np.abs(inverse) @ size[motion] / frame
    basis = np.hstack([form @ standing, form @ second + late @ (standing @ shares)])
    terms = RIGID_ROUNDINGS + n
    doubt = np.hstack(
        [
            terms * UNIT * (np.abs(form) @ np.abs(standing)),
            terms * UNIT * (np.abs(form) @ np.abs(second))
            + np.abs(late) @ np.abs(standing) @ (unsure + terms * UNIT * np.abs(shares)),
        ]
    )
    return basis, doubt


def _with_turns(spectrum: Spectrum, whole: Spectrum) -> Spectrum:
    """Return a spectrum with the frequencies of another of the same eigenvalues.

    The lifted matrices know a frame's ticks and nothing in between: whole turns there are counted elsewhere.
    """
    values = np.array([mode.eigenvalue for mode in whole.modes])
    modes = []
    for mode in spectrum.modes:
        near = int(np.argmin(np.abs(values - mode.eigenvalue))) if np.isnan(mode.frequency_hz) else -1
        same = whole.modes[near] if near >= 0 else mode
        if same is mode or abs(same.eigenvalue - mode.eigenvalue) <= same.error + mode.error:
            (own,), (other,) = mode.motion, same.motion
            own = replace(own, frequency_hz=other.frequency_hz, damping_ratio=other.damping_ratio)
            mode = replace(mode, motion=(own,))
        modes.append(mode)
    return replace(spectrum, modes=tuple(modes))


def _with_rigid(spectrum: Spectrum, rigid: RigidModes) -> Spectrum:
    """Return the spectrum of the rest with what the rigid motions add to the verdict."""
    count, drifts = rigid.directions.shape[1], rigid.drifts
    verdict, stable = spectrum.verdict, spectrum.stable
    if verdict == STABLE and count:
        verdict, stable = (DRIFTS, False) if drifts else (STABLE_TRANSLATING, True)
    return replace(spectrum, verdict=verdict, stable=stable, rigid_modes=count, drifts=drifts)
