"""Transparency: the impedance at a device, and the transmission of a force to another device.

Takes: a `NumericModel`, a device, frequencies.
Gives: `Transparency`, `transparency`; `QuasiStaticImpedance`.
Guarantees: at each frequency the response is exact for the sampled, held and sent signals of the model, with
a bound on its rounding; no aliasing: a frequency beyond half the fastest clock rate raises an error.
Does not: include the dynamics of a hand (see `absolute_stability`), or packets that are lost or late.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze as judge
from apc.analysis.analysis import near_start
from apc.analysis.nonlinear_elements import is_linear
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.haptics.device_port import DevicePort, check_frequencies, find_port, next_peer
from apc.haptics.peer_responses import AROUND, Responses, device_labels, responses
from apc.haptics.response_norms import H2Gains, HinfGains, NetworkDamping
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import limitations
from apc.result import PlotStyle, Result
from apc.support.extension_table import find_extension, not_installed, require_extension
from apc.verdict import Limitation, LimitationCode

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

# The optional results in addition to the responses.
ALONGSIDE = ("low_frequency", "network_damping", "hinf", "h2")
NORMS = {"network_damping", "hinf", "h2"}  # those of the extension

# The harmonics of the frame rate that are evaluated in addition to the fundamental.
ALIASES = (0, 1, -1)

# Radii of circles about s = 0, in 1/s: the largest, and the number of halvings.
RADIUS, HALVINGS = 4.0, 14

# The factor above rounding at which the means of values times positive powers indicate a pole in the circle.
DOUBTED = 10.0

# The tolerated difference of quasi-static results of two circles, relative to the largest.
SETTLED = 1e-3


@dataclass(frozen=True, slots=True)
class QuasiStaticImpedance:
    """The quasi-static impedance at a device, valid down to about 1e-3 1/s, in SI units.

    Z = stiffness/s + damping + mass · s + …; `errors` are the error bounds in the order of the fields.
    """

    mass: float
    damping: float
    stiffness: float
    errors: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Transparency(Result):
    """The responses at a device, and from this device to another, at frequencies (k,) in Hz.

    `impedance` in N·s/m is force by velocity, with the other devices free; `transmitted_admittance` in m/s/N
    is the other device's velocity by the force, `coordination_error` in m/N the distance of the driven peer's
    object copy from the mean of the others. All are complex, at the fundamental. `aliased_fraction` is the
    largest ratio of an alias (a frame rate away) at the device to the fundamental. `network_damping` is the
    part of the damping caused by the network. `bound` is the relative error bound of the impedance;
    `transmitted_bound` and `error_bound` are those of the others.
    """

    shown_by = "haptics_output:transparency"

    topology: str
    at: str
    between: str
    object: str
    frequency_hz: Floats
    impedance: Complex
    transmitted_admittance: Complex
    coordination_error: Complex
    aliased_fraction: Floats
    bound: Floats
    transmitted_bound: Floats
    error_bound: Floats
    low_frequency: QuasiStaticImpedance | None
    network_damping: NetworkDamping | None
    hinf: tuple[HinfGains, ...]
    h2: tuple[H2Gains, ...]
    stable: bool | None
    linearized: bool
    at_equilibrium: bool
    limitations: tuple[str, ...]
    notes: tuple[Limitation, ...]

    def plot(self, ax: Any = None, *, kind: str = "bode", **style: Unpack[PlotStyle]) -> Any:
        """Draw a Bode or Nyquist plot in the style `style` (see `result.PlotStyle`); return the matplotlib
        Figure.

        Parameters
        ----------
        ax
            The matplotlib Axes to draw into; a Bode plot then has the magnitudes alone.
        kind
            "bode" or "nyquist".
        """
        return self._plotted(kind, ax, style=style)


@part("transparency")
def transparency(
    numeric: NumericModel,
    frequencies: Sequence[float] | Floats,
    *,
    at: str = "",
    between: str = "",
    unstable: bool = False,
    alongside: Collection[str] | None = None,
) -> Transparency:
    """Return the transparency of a model at a device.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    frequencies
        The frequencies (k,) in Hz, above 0 and at most half the rate of the fastest clock.
    at, between
        The driven device and a second one, such as `left[1].device`. The defaults are the first device of
        the first peer with a device, along its first direction, and that of the next peer.
    unstable
        Whether an unstable model is allowed: its map from force to motion has no response in time.
    alongside
        The names of the optional results, from `ALONGSIDE`; each takes some tens of milliseconds. By default
        all that are installed.

    Raises
    ------
    ApcError
        E931 a peer without a device; E934 an unstable model; E935 a frequency beyond half the fastest clock
        rate, or none above 0; E936 an unknown name; E933 a model too large.
    """
    model = numeric.model
    result = np.asarray(frequencies, dtype=np.float64).ravel()
    device_names = [] if at else device_labels(numeric)
    port = find_port(model, at or next(iter(device_names), ""), "--at")
    other = find_port(model, between, "--between") if between else DevicePort(next_peer(model, port), "")
    check_frequencies(model, result)
    optional = alongside is None
    norms = find_extension("system_norms") if optional else None
    if alongside is None:
        alongside = ALONGSIDE if norms else ALONGSIDE[:1]
    elif not NORMS.isdisjoint(alongside):
        norms = require_extension("system_norms")
    verdict = judge(numeric)
    if verdict.stable is False and not unstable:
        raise _unstable_error(model, verdict.spectral_radius)
    with evaluating(model):
        response = responses(numeric, port, other)
        s = np.asarray(2j * np.pi * result, dtype=np.complex128)
        driven, *aliases, transmitted, error = response.steady(s, ALIASES)
        values = 1 / driven[0]
        alias = np.max([np.abs(value) for value, _ in aliases], axis=0) / np.abs(driven[0])
        bounds = [
            1.01 * error_bound / np.where(value == 0, np.inf, np.abs(value))
            for value, error_bound in (driven, transmitted, error)
        ]
        is_stable = verdict.stable is not False
        quasi_static = _quasi_static(response) if "low_frequency" in alongside else None
        viscosity = (
            _network_part_of_damping(norms, model, quasi_static, port, other)
            if norms and quasi_static and "network_damping" in alongside
            else None
        )
        hinf = norms.hinf_gains(response, result) if norms and "hinf" in alongside else ()
        h2 = norms.h2_gains(model, response) if norms and is_stable and "h2" in alongside else ()
    linear = is_linear(numeric)
    driven_name, other_name = (
        f"{response.comm_graph.peer_name(item.peer)}.{device.part}"
        for item, device in ((port, response.device), (other, response.other))
    )
    directions = [
        text for text in device_names if text.partition(".")[0] == device_names[0].partition(".")[0]
    ]
    others = ", ".join(f"--at {direction}" for direction in directions[1:])
    applicable = {
        Limitation(LimitationCode.ONE_DIRECTION, (others,)): len(directions) > 1,
        Limitation(LimitationCode.UNSTABLE_MAP): verdict.stable is False,
        Limitation(LimitationCode.SLOWER_MOTION): not quasi_static and "low_frequency" in alongside,
        Limitation(LimitationCode.COUPLED_COPIES): "hinf" in alongside and bool(response.error[0]),
        not_installed("system_norms"): optional and norms is None,
        Limitation(LimitationCode.CLOCK_PHASE): is_stable and not h2 and "h2" in alongside,
    }
    return Transparency(
        topology=model.name,
        at=driven_name,
        between="" if other_name == driven_name else other_name,
        object=response.object,
        frequency_hz=result,
        impedance=values,
        transmitted_admittance=transmitted[0],
        coordination_error=error[0],
        aliased_fraction=alias,
        bound=bounds[0],
        transmitted_bound=bounds[1],
        error_bound=bounds[2],
        low_frequency=quasi_static,
        network_damping=viscosity,
        hinf=hinf,
        h2=h2,
        stable=verdict.stable,
        linearized=not linear,
        at_equilibrium=model.at_equilibrium,
        limitations=(*near_start(numeric), *limitations(model)),
        notes=tuple(limitation for limitation, applies in applicable.items() if applies),
    )


def _network_part_of_damping(
    norms: Any, model: Model, slow: QuasiStaticImpedance, port: DevicePort, other: DevicePort
) -> NetworkDamping | None:
    """Return the part of the quasi-static damping that is caused by the network, None if undetermined."""

    def damping_of(changed: Model) -> tuple[float, float] | None:
        """Return the quasi-static damping of a model with its error, None if undetermined."""
        slow = _quasi_static(responses(numeric_model(changed), port, other))
        return None if slow is None else (slow.damping, slow.errors[1])

    result: NetworkDamping | None = norms.network_damping(model, (slow.damping, slow.errors[1]), damping_of)
    return result


def _unstable_error(model: Model, radius: float) -> ApcError:
    """Return the error E934 for an unstable model."""
    message = (
        f"the topology is unstable (spectral radius {radius:.6g}) and has no steady-state frequency response"
    )
    fix = "--unstable"
    return ApcError(Diagnostic("E934", SourceLocation(model.origin.topology), message, fix=fix))


def _quasi_static(response: Responses) -> QuasiStaticImpedance | None:
    """Return mass, damping and stiffness at low frequency, None if undetermined.

    Notes
    -----
    s Z(s) has no pole within a small circle about 0, so its Taylor coefficients are the means of its values
    on the circle divided by powers of s (Cauchy); the results of two circles differ by the truncation error.
    With a pole inside, the means of the values times powers of s do not vanish.
    """
    previous, radius = None, RADIUS
    best: QuasiStaticImpedance | None = None
    least = SETTLED
    for _ in range(HALVINGS):
        s = radius * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
        (velocity, error_bound), *_ = response.at(s, difference_loops=False)
        values, powers = s / velocity, radius ** np.arange(3)
        uncertainty = float((np.abs(values) * error_bound / np.abs(velocity)).max())
        result = np.array([(values / s**power).mean().real for power in range(3)])
        if previous is not None:
            pole_mean = max(abs((values * (s / radius) ** power).mean()) for power in (1, 2, 3))
            error_bound = np.abs(result - previous) + (uncertainty + pole_mean) / powers
            # A term is negligible at this frequency if it is far smaller than the largest.
            relative_error = float((error_bound * powers).max() / np.abs(result * powers).max())
            if relative_error < least and pole_mean <= DOUBTED * uncertainty:
                least, (k, b, m), (error_k, error_b, error_m) = (
                    relative_error,
                    result.tolist(),
                    error_bound.tolist(),
                )
                best = QuasiStaticImpedance(m, b, k, (error_m, error_b, error_k))
        previous, radius = result, radius / 2
    return best
