"""Absolute stability: stability with every passive hand at every device.

Takes: a `NumericModel`.
Gives: `AbsoluteStability`, `PassiveMode`, `absolute_stability`; `passivity_radius`, `loop_growths`;
`is_nonreciprocal`, `frequency_of`.
Guarantees: verdicts do not depend on a grid of frequencies; a verdict is proved, or undecided. A hand is any
passive operator, separate at each device or, for devices with reciprocal interaction, also a joint one.
Does not: construct a destabilizing hand; the mode from which energy can be extracted is named.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze, lifted_classes, near_start
from apc.analysis.contact_modes import contact_modes
from apc.analysis.nonlinear_elements import is_linear
from apc.analysis.one_sided_slopes import severity, sides
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.haptics.displacement_port import PortLoop, port_loops
from apc.haptics.published_limits import published_limits
from apc.lifting.devices import clamped, directions_of, replaced_hands, without_hands
from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    error_radius,
    solve,
    value_of,
    with_error_radius,
)
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.mean_square.mean_square_stability import StabilityMeasure
from apc.network.nominal_criterion import limitations
from apc.result import Result
from apc.spectrum.kyp_bounds import least_real, proves_positive
from apc.spectrum.modes import split
from apc.support.not_supported import NotSupportedError
from apc.support.threads import load_pool
from apc.verdict import NO_PROOF, ProofMethod, ProofScope, StabilityProof, Term

Complexes = NDArray[np.complex128]

OPTION = "--hands passive"

CIRCULATES = (
    "The static forces between devices are not conservative: in a slow closed cycle they generate energy "
    "at any damping"
)

# The relative margins of a proof below the computed minimum, tried in order; and the fraction of the margin
# that a proof leaves for rounding.
WIDTHS, SPARED = (1e-9, 3e-9, 1e-8, 1e-7, 1e-5), (1e-2, 1e-3)

# The first margins for a verdict: more digits than are shown, in a third of the time.
SHOWN = (1e-7, 1e-5)

# The relative difference of equal fits of two frequencies.
SIMILAR = 1e-6


class PassivityVerdict(Term):
    """The verdict over all passive hands; `NEVER`: unstable with any damping."""

    STABLE = "stable with any passive hands"
    UNSTABLE = "unstable with some passive hands"
    UNDECIDED = "undecided"
    NEVER = "unstable with some passive hands at any damping"


@dataclass(frozen=True, slots=True)
class PassiveMode:
    """A mode with hands at its devices: the common mode, or a difference mode.

    `damping` is that of its devices in N·s/m, None if they differ; `more` ± `error` is the additional damping
    that each device requires, negative for a reserve; None if no damping suffices: the model is unstable with
    its devices clamped, or the static forces at devices are not those of springs. `frequency_hz` is the
    frequency of the largest extractable energy. `stiffness` is the static stiffness at its devices in N/m,
    None if the mode spans several groups.
    """

    name: str
    multiplicity: int
    passive: bool | None
    damping: float | None
    more: float | None
    error: float | None
    frequency_hz: float | None
    stiffness: float | None

    @property
    def needed(self) -> float | None:
        """The smallest sufficient damping of each device in N·s/m, None if unknown."""
        return None if self.damping is None or self.more is None else self.damping + self.more


@dataclass(frozen=True, slots=True)
class AbsoluteStability(Result):
    """The result of the test of a model with every passive hand at its devices.

    `clamped_radius` ± `clamped_error` is the spectral radius with all devices clamped, the stiffest hand.
    `joined` states that the result also holds for joint passive hands; without reciprocity it holds for
    separate hands. `why` is the reason if no damping suffices, as a consequence of the equations.
    """

    shown_by = "haptics_output:passive"

    topology: str
    verdict: PassivityVerdict
    stable: bool | None
    clamped_stable: bool | None
    clamped_radius: float
    clamped_error: float
    modes: tuple[PassiveMode, ...]
    joined: bool
    why: str
    proof: StabilityProof
    linearized: bool
    at_equilibrium: bool
    limitations: tuple[str, ...]

    @property
    def worst_mode(self) -> PassiveMode | None:
        """The mode that requires the most damping, None without modes."""
        passive_modes = [mode for mode in self.modes if mode.more is not None]
        insufficient = [mode for mode in self.modes if mode.more is None]
        return (
            insufficient[0]
            if insufficient
            else max(passive_modes, key=lambda passive_mode: passive_mode.more or 0.0)
            if passive_modes
            else None
        )


@part("passive hands")
def absolute_stability(numeric: NumericModel, *, certify: bool = False) -> AbsoluteStability:
    """Return the verdict on a model's stability with every passive hand at every device.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    certify
        Whether the result for clamped devices is proved in ball arithmetic, if the verdict depends on it.

    Raises
    ------
    ApcError
        E931 a peer without a device; E932 hands in the topology; E933 a device that is affected by other
        signals than samples and held forces, or too many intervals; and the errors of `analysis.analyze`.

    Notes
    -----
    After Colgate and Schenkel, J. Robotic Systems 14 (1997) 37, for any number of devices, delays and clocks:
    see `displacement_port`.
    """
    results = {
        axis: _stability_along_line(part, certify=certify)
        for axis, part in _models_by_direction(numeric).items()
    }
    return _combined_directions(results, replaced_hands(numeric.model))


def _stability_along_line(numeric: NumericModel, *, certify: bool) -> AbsoluteStability:
    """Return the verdict of a model without hands whose devices move along a line."""
    clamped_analysis = analyze(numeric_model(clamped(numeric.model, option=OPTION)), certify=certify)
    results = [
        _one_sided_hand_conditions(side.numeric, clamped_analysis, certify=certify) for side in sides(numeric)
    ]
    worst = max(results, key=lambda hands: severity(hands.stable, _missing_damping(hands)))
    return replace(worst, limitations=_limitations(numeric))


def _missing_damping(hands: AbsoluteStability) -> float:
    """Return the additional damping in N·s/m that the worst mode requires, infinite if none suffices."""
    worst = hands.worst_mode
    return -math.inf if worst is None else math.inf if worst.more is None else worst.more


def _limitations(numeric: NumericModel) -> tuple[str, ...]:
    """Return the limitations of a result with passive hands."""
    return (
        *near_start(numeric),
        *published_limits(numeric.model),
        *limitations(numeric.model),
        *_contact_note(numeric, linear=numeric.affine),
    )


def _one_sided_hand_conditions(
    numeric: NumericModel,
    fixed: Analysis,
    *,
    certify: bool,
) -> AbsoluteStability:
    """Return the verdict of a model without kinks whose devices move along a line.

    `fixed` is the analysis with its devices clamped.
    """
    with evaluating(numeric.model):
        loops: tuple[PortLoop, ...] = ()
        unsupported = ""
        try:
            loops = port_loops(numeric, option=OPTION)
        except NotSupportedError as why:
            unsupported = str(why)
        modes = tuple(_passive_mode(loop) for loop in loops)
        never_reason = unsupported or (CIRCULATES if any(map(is_nonreciprocal, loops)) else "")
    linear = is_linear(numeric)
    stable: bool | None = None
    joined = not unsupported and all(loop.joined for loop in loops)
    mode_fails = [mode.passive is False and (joined or mode.more is None) for mode in modes]
    if unsupported or fixed.stable is False or any(mode_fails):
        stable = False
    elif all(mode.passive for mode in modes) and fixed.stable:
        stable = True
    verdict = {
        True: PassivityVerdict.STABLE,
        False: PassivityVerdict.UNSTABLE,
        None: PassivityVerdict.UNDECIDED,
    }[stable]
    bounded = StabilityProof(ProofMethod.ROUNDED, scope=(ProofScope.LINEARIZATION,) * (not linear))
    proof = NO_PROOF if stable is None else bounded
    if certify and fixed.stable is False and not never_reason:
        proof = fixed.proof or bounded
        proof = replace(proof, scope=(*proof.scope, ProofScope.CLAMPED_DEVICES))
    return AbsoluteStability(
        topology=numeric.model.name,
        verdict=PassivityVerdict.NEVER if never_reason else verdict,
        stable=stable,
        clamped_stable=fixed.stable,
        clamped_radius=fixed.spectral_radius,
        clamped_error=fixed.spectral_radius_error,
        modes=modes,
        joined=joined,
        why=never_reason,
        proof=proof,
        linearized=not linear,
        at_equilibrium=numeric.model.at_equilibrium,
        limitations=(),
    )


def _models_by_direction(numeric: NumericModel) -> dict[str, NumericModel]:
    """Return the model without hands along each direction of its devices, "" if all move along a line.

    Raises
    ------
    ApcError
        E933 motions along different directions are coupled.
    """
    model = without_hands(numeric.model, OPTION)
    numeric = numeric if model is numeric.model else numeric_model(model)
    along = directions_of(model)
    for loop in split(*lifted_classes(sides(numeric)[0].numeric)) if along else ():
        parts = load_pool("scipy.sparse.csgraph").connected_components(loop.matrix != 0, connection="weak")[1]
        axes_of_part: dict[str, set[str]] = {}
        for name, part_label in zip(loop.layout.names, parts.tolist(), strict=True):
            if (axis := f"x{name[name.rindex('[') :]}" if "[" in name else "") in along:
                axes_of_part.setdefault(str(part_label), set()).add(axis)
        if any(len(axes) > 1 for axes in axes_of_part.values()):
            message = f"{OPTION}: devices move along several coupled axes ({', '.join(along)})"
            raise ApcError(Diagnostic("E933", SourceLocation(model.origin.topology), message))
    return {axis: numeric_model(part) for axis, part in along.items()} or {"": numeric}


def _combined_directions(
    results: Mapping[str, AbsoluteStability], replaced: tuple[str, ...]
) -> AbsoluteStability:
    """Return the common result of all directions, which are uncoupled."""
    verdicts = [part.stable for part in results.values()]
    stable = False if False in verdicts else None if None in verdicts else True
    representative = next(part for part in results.values() if part.stable is stable)
    modes = tuple(
        replace(mode, name=f"{mode.name}, {axis}" if axis else mode.name)
        for axis, part in results.items()
        for mode in part.modes
    )
    joined = all(part.joined for part in results.values())
    return replace(
        representative, modes=modes, joined=joined, limitations=(*replaced, *representative.limitations)
    )


def _contact_note(numeric: NumericModel, *, linear: bool) -> tuple[str, ...]:
    """Return a note on contacts that are assumed constant, although hands may open and close them."""
    if linear:
        return ()
    try:
        parts = contact_modes(numeric).parts
    except ApcError:  # too many to list: a note on linearization is given
        return ()
    if not parts:
        return ()
    note = f"excluded: opening and closing of contacts ({', '.join(parts)}); their initial state is assumed"
    return (note,)


def passivity_radius(numeric: NumericModel, *, bounded: bool = True) -> StabilityMeasure:
    """Return a number below 1 for stability with every passive hand, and above 1 otherwise, with bounds.

    With n the damping required at each device and b the largest present damping, it is e^{2 (n − b)/(n + b)}.
    n tends to infinity at the limit of stability with devices clamped; the number is continuous there, and e²
    beyond.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    bounded
        Whether proved bounds are required.
    """
    growths = loop_growths(numeric, bounded=bounded)
    radius, low, high = (
        max(getattr(growth, name) for growth in growths) for name in ("radius", "low", "high")
    )
    return StabilityMeasure(radius, low, high, exact=True, proved=bounded)


def loop_growths(numeric: NumericModel, *, bounded: bool = True) -> list[StabilityMeasure]:
    """Return the number of `passivity_radius` for each closed loop: the largest is that of the model.

    Parameters
    ----------
    numeric, bounded
        As for `passivity_radius`.
    """
    models = _models_by_direction(numeric).values()
    return [growth for part in models for growth in _growths_along_line(part, bounded=bounded)]


def _growths_along_line(numeric: NumericModel, *, bounded: bool) -> list[StabilityMeasure]:
    """Return the number of each closed loop of a model without hands whose devices move along a line."""
    with evaluating(numeric.model):
        reserves, scale = [(-np.inf, -np.inf, -np.inf)], 1.0
        with suppress(NotSupportedError):
            loops = [loop for side in sides(numeric) for loop in port_loops(side.numeric, option=OPTION)]
            reserves = [
                _bounds(loop)[:3]
                if bounded
                else (-np.inf if is_nonreciprocal(loop) else _least_eigenvalue(loop)[0],) * 3
                for loop in loops
            ]
            scale = max(float(damping) for loop in loops for damping in loop.dampings) or 1.0
    worst = min(reserves)
    if (
        bounded
        and np.isneginf(worst[0])
        and not np.isneginf(min(upper for *_, upper in reserves))
        and analyze(numeric_model(clamped(numeric.model, option=OPTION))).stable is False
    ):
        reserves.append((-np.inf, -np.inf, -np.inf))  # floats alone decided
    return [_passivity_radius(scale, *bounds) for bounds in reserves]


def _passivity_radius(scale: float, *reserve: float) -> StabilityMeasure:
    """Return e^{2 (n − b)/(n + b)} with bounds, from the largest damping b and bounds on the
    reserve b − n.
    """
    needed = [scale - value for value in reserve]
    logs = [np.sign(value) if np.isinf(value) else (value - scale) / (abs(value) + scale) for value in needed]
    radius, high, low = (float(np.exp(2 * log)) for log in logs)
    if reserve[1] >= 0:  # passive, at the margin
        high = min(high, float(np.nextafter(1.0, 0.0)))
    return StabilityMeasure(radius, low, high, exact=True, proved=True)


def _passive_mode(loop: PortLoop) -> PassiveMode:
    """Return the passivity of a mode: whether hands can extract energy, and the missing damping."""
    least, low, high, angle = _bounds(loop, SHOWN)
    if low < 0 <= high:
        least, low, high, angle = _bounds(loop)
    dampings = set(loop.dampings)
    is_finite = bool(np.isfinite(least))
    return PassiveMode(
        name=loop.name,
        multiplicity=loop.multiplicity,
        passive=True if low >= 0 else False if high < 0 else None,
        damping=float(dampings.pop()) if len(dampings) == 1 else None,
        more=-least if is_finite else None,
        error=max(high - least, least - low) if is_finite else None,
        frequency_hz=frequency_of(loop, angle) if is_finite else None,
        stiffness=float(loop.static[0, 0, 0]) if loop.static.shape[-1] == 1 else None,
    )


def _bounds(loop: PortLoop, margins: Sequence[float] = WIDTHS) -> tuple[float, float, float, float]:
    """Return the smallest eigenvalue of He H + diag(b/τ) over all angles, proved bounds on it, and its angle.

    The lower bound is below the eigenvalue by the smallest of some relative margins that can be proved. The
    eigenvalue is −∞ for an unstable model with clamped devices (not proved), and if slow motions extract
    energy (proved).
    """
    if is_nonreciprocal(loop):
        return -np.inf, -np.inf, -np.inf, 0.0
    matrices = loop.a, loop.b, loop.c, loop.d
    least, angle = _least_eigenvalue(loop)
    if not np.isfinite(least):
        return least, -np.inf, np.inf, angle
    scale = max(abs(least), float(np.abs(value_of(loop.weight)).max()))
    low = -np.inf
    for margin in margins:
        shift = least - margin * scale
        shifted_weight = MIDPOINT_RADIUS.subtract(
            loop.weight, MIDPOINT_RADIUS.exact(shift * np.eye(len(loop.weight[0])))
        )
        if proves_positive(*matrices, shifted_weight, spared=[share * margin for share in SPARED]):
            low = shift
            break
    else:
        if least > 0 and proves_positive(*matrices, loop.weight):
            low = 0.0
    return least, low, _upper_bound(loop, angle), angle


def _least_eigenvalue(loop: PortLoop) -> tuple[float, float]:
    """Return the smallest eigenvalue of He H + diag(b/τ) over all angles, and its angle, in floats."""
    return least_real(*map(value_of, (loop.a, loop.b, loop.c, loop.d, loop.weight)))


def is_nonreciprocal(loop: PortLoop) -> bool:
    """Return whether the static stiffness is not that of springs: hands can extract energy by slow motions.

    Parameters
    ----------
    loop
        A mode.

    Notes
    -----
    The residue at z = 1 has to be symmetric and positive semidefinite, or hands that move devices slowly
    around a cycle extract energy. A residue that is zero up to rounding counts as zero.
    """
    value, error_bound = value_of(loop.static), error_radius(loop.static)
    is_asymmetric = np.abs(value - value.T) > error_bound + error_bound.T
    least = float(np.linalg.eigvalsh((value + value.T) / 2).min())
    return bool(is_asymmetric.any()) or least < -2 * float((error_bound + error_bound.T).sum())


def _upper_bound(loop: PortLoop, angle: float) -> float:
    """Return a proved upper bound on the smallest eigenvalue of He H + diag(b/τ) at an angle."""
    tangent = float(np.tan(angle / 2))
    z = complex(1 - tangent**2, 2 * tangent) / (1 + tangent**2)
    direction = _worst_mode(loop, z)[:, None]
    # Both parts are quotients of sums of order 1: their errors are roundings of 1, however small they are.
    unit, v = np.eye(loop.a.shape[-1]), MIDPOINT_RADIUS.exact(direction)
    states = solve(
        MIDPOINT_RADIUS.subtract(with_error_radius(z * unit, 16 * UNIT_ROUNDOFF * unit), loop.a),
        MIDPOINT_RADIUS.multiply(loop.b, v),
    )
    if states is None:
        return np.inf
    through = MIDPOINT_RADIUS.multiply(MIDPOINT_RADIUS.add(loop.d, loop.weight), v)
    quadratic_form = MIDPOINT_RADIUS.multiply(
        MIDPOINT_RADIUS.exact(direction.conj().T),
        MIDPOINT_RADIUS.add(MIDPOINT_RADIUS.multiply(loop.c, states), through),
    )
    size = float(np.vdot(direction, direction).real)
    numerator = float(quadratic_form[0, 0, 0].real + quadratic_form[1, 0, 0].real)
    return numerator / size + 8 * UNIT_ROUNDOFF * abs(numerator)


def _worst_mode(loop: PortLoop, z: complex) -> Complexes:
    """Return the eigenvector of the smallest eigenvalue of He H + diag(b/τ) at a point z of the circle."""
    a, b, c, d, weight = map(value_of, (loop.a, loop.b, loop.c, loop.d, loop.weight))
    response = c @ np.linalg.solve(z * np.eye(len(a)) - a, b + 0j) + d
    return np.asarray(np.linalg.eigh((response + response.conj().T) / 2 + weight)[1][:, 0])


def frequency_of(loop: PortLoop, angle: float) -> float:
    """Return the frequency in Hz of the motion with the largest extractable energy at an angle.

    Parameters
    ----------
    loop
        A mode.
    angle
        The phase advance in a frame, up to multiples of 2π.

    Notes
    -----
    Frequencies that differ by a multiple of the frame rate have the same angle: the motion within a frame
    determines the dominant one.
    """
    displacements = _worst_mode(loop, complex(np.exp(1j * angle))) * np.sqrt(loop.seconds)
    largest_multiple = round(loop.frame_s / float(loop.seconds.min()) / 2) + 1
    values = sorted(
        angle + 2 * np.pi * multiple for multiple in range(-largest_multiple, largest_multiple + 1)
    )
    values.sort(key=abs)  # of two equal fits, the lower frequency
    # A device moves at constant velocity in each interval: the share of each frequency, over all devices.
    middles, device = loop.starts + loop.seconds / 2, np.cumsum(loop.starts == 0) - 1
    is_of_device = device == np.arange(device[-1] + 1)[:, None]
    phases = np.outer(values, middles) / loop.frame_s
    shares = np.sinc(np.outer(values, loop.seconds) / (2 * np.pi * loop.frame_s))
    fits = np.linalg.norm((np.exp(-1j * phases) * shares * displacements) @ is_of_device.T, axis=1)
    best = next(value for value, fit in zip(values, fits, strict=True) if fit >= max(fits) * (1 - SIMILAR))
    return abs(best) / (2 * np.pi * loop.frame_s)
