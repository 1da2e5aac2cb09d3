"""An external device that replaces a peer's simulated one: a measured position, an applied force.

Takes: a file with one function, in Python or C; a peer's program. Gives: `ExternalDevice`, `device_function`.
Guarantees: the device function is called for its position at the start of a tick, and with the force at its
end.
Does not: enforce device limits, or filter measurements. The velocity is the difference quotient of the last
two positions.

The function is called at each instant with a tick; `time` is in seconds of the model:

    def device(time, force):                      double apc_device(double time, const double *force);
        if force is None:                         force is NULL: measure, and return the position in m
            return position                       else exert *force, in N, return anything
        exert(force)

The force is the sum of all held coupler outputs that act on the device's mass.
"""

from __future__ import annotations

import ctypes
import math
import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.devices import devices_of
from apc.simulation.program import GroupProgram

NAMES = {".py": "device", ".so": "apc_device"}

DeviceFunction = Callable[[float, float | None], float]


def device_function(path: Path) -> DeviceFunction:
    """Return the device function of a file. Raises ApcError E976 if the file has none."""
    name = NAMES.get(path.suffix)
    fix = "--device device.py"
    if name is None:
        expected, got = f"one of {', '.join(NAMES)}", path.suffix or "none"
        raise ApcError(
            Diagnostic("E976", SourceLocation(str(path)), "suffix of --device", expected, got, fix)
        )
    try:
        if path.suffix == ".py":
            return runpy.run_path(str(path))[name]  # type: ignore[no-any-return] # user code
        function = ctypes.CDLL(str(path.resolve()))[name]
    except Exception as error:  # whatever the user's own code raises
        message = f"has no function {name}(time, force) that can be loaded: {type(error).__name__}: {error}"
        raise ApcError(Diagnostic("E976", SourceLocation(str(path)), message, fix=fix)) from None
    function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double, ctypes.POINTER(ctypes.c_double)]
    return lambda time, force: float(
        function(time, None if force is None else ctypes.byref(ctypes.c_double(force)))
    )


class ExternalDevice:
    """An external device in place of a peer's simulated device."""

    def __init__(self, model: Model, member: GroupProgram, function: DeviceFunction) -> None:
        """Determine the device's states in the peer's equations.

        Raises
        ------
        ApcError
            E931 the peer has no device, or several candidates for a hand.
        """
        self.function = function
        peer_type = model.groups[member.group].peer_type
        self.device = devices_of(model, option="--device")[peer_type]
        self.derivative = model.peer_types[peer_type].derivative
        self.parameters = member.parameters[member.rows[0]]
        self.before: tuple[float, float] | None = None

    def measure(self, time: float, carry: NDArray[np.float64]) -> None:
        """Write the measured position and velocity into the states of the device, `carry` (rows, 1)."""
        result = self._request(time, None)
        if not (isinstance(result, int | float | np.floating) and math.isfinite(result)):
            message = f"returned {result!r:.40} as position at {time:.6g} s"
            raise ApcError(
                Diagnostic("E976", SourceLocation("--device"), message, advice="return a finite number in m")
            )
        position = float(result)
        if self.before is not None and time > self.before[0]:
            carry[self.device.velocity] = (position - self.before[1]) / (time - self.before[0])
        carry[self.device.position] = position
        self.before = time, position

    def push(self, time: float, x: NDArray[np.float64], held: NDArray[np.float64]) -> None:
        """Call the device with the force from this instant on: the effect of `held` (holds,) on the
        device's mass.
        """
        rates = [
            np.asarray(self.derivative(x, u, self.parameters, time)).reshape(-1)[self.device.velocity]
            for u in (held, np.zeros_like(held))
        ]
        inverse = float(self.device.symbolic(x, held, self.parameters, time))
        self._request(time, float(rates[0] - rates[1]) / inverse)

    def _request(self, time: float, force: float | None) -> object:
        """Return the result of the device function. Raises ApcError E976 for an exception in user code."""
        try:
            return self.function(time, force)
        except Exception as error:  # whatever the user's own code raises
            message = f"raised {type(error).__name__} at {time:.6g} s: {error}"
            raise ApcError(Diagnostic("E976", SourceLocation("--device"), message)) from None
