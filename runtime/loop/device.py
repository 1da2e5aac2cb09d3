"""A device outside, in the place of a peer's simulated one: a position measured, a force exerted.

Takes: a file with one function, in Python or C; a peer's program. Gives: `Outside`, `device_function`.
Guarantees: it is asked for its position as a tick begins, and told its force as that is over.
Does not: keep a device within its limits, or filter what it measures: a velocity is the last two positions'
slope.

The function is called at each instant at which anything ticks, `time` in seconds of the scene:

    def device(time, force):                      double apc_device(double time, const double *force);
        if force is None:                         force is NULL: measure, and return the position in m
            return position                       else exert *force, in N, until told again; return anything
        exert(force)

The force is that of all couplers which hold what they computed, as it acts on the device's mass.
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
from apc.frame.devices import devices_of
from apc.simulation.program import GroupProgram

NAMES = {".py": "device", ".so": "apc_device"}

DeviceFunction = Callable[[float, float | None], float]


def device_function(path: Path) -> DeviceFunction:
    """Return the function of a file. Raises ApcError E976 if there is none."""
    name = NAMES.get(path.suffix)
    hint = "--device device.py"
    if name is None:
        expected, got = f"one of {', '.join(NAMES)}", path.suffix or "none"
        raise ApcError(
            Diagnostic("E976", SourceLocation(str(path)), "the suffix of --device", expected, got, hint)
        )
    try:
        if path.suffix == ".py":
            return runpy.run_path(str(path))[name]  # type: ignore[no-any-return] # what a user wrote
        function = ctypes.CDLL(str(path.resolve()))[name]
    except Exception as error:  # whatever the user's own code raises
        what = f"has no function {name}(time, force) that can be loaded: {type(error).__name__}: {error}"
        raise ApcError(Diagnostic("E976", SourceLocation(str(path)), what, hint=hint)) from None
    function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double, ctypes.POINTER(ctypes.c_double)]
    return lambda time, force: float(
        function(time, None if force is None else ctypes.byref(ctypes.c_double(force)))
    )


class Outside:
    """A peer's device outside."""

    def __init__(self, system: Model, member: GroupProgram, exchange: DeviceFunction) -> None:
        """Find what stands for the device in the peer's equations.

        Raises
        ------
        ApcError
            E931 the peer has no device, or several that a hand might hold.
        """
        self.exchange = exchange
        kind = system.groups[member.group].kind
        self.device = devices_of(system, option="--device")[kind]
        self.derivative = system.kinds[kind].derivative
        self.parameters = member.parameters[member.rows[0]]
        self.before: tuple[float, float] | None = None

    def measure(self, time: float, carry: NDArray[np.float64]) -> None:
        """Put what is measured into the states of the device; `carry` (rows, 1) is written over."""
        result = self._asked(time, None)
        if not (isinstance(result, int | float | np.floating) and math.isfinite(result)):
            what = f"gave {result!r:.40} as its position at {time:.6g} s"
            raise ApcError(
                Diagnostic("E976", SourceLocation("--device"), what, hint="return a finite number, in m")
            )
        position = float(result)
        if self.before is not None and time > self.before[0]:
            carry[self.device.velocity] = (position - self.before[1]) / (time - self.before[0])
        carry[self.device.position] = position
        self.before = time, position

    def push(self, time: float, x: NDArray[np.float64], held: NDArray[np.float64]) -> None:
        """Say what force acts from now on: what `held` (holds,) do to the device's velocity, by its mass."""
        rates = [
            np.asarray(self.derivative(x, u, self.parameters, time)).reshape(-1)[self.device.velocity]
            for u in (held, np.zeros_like(held))
        ]
        inverse = float(self.device.symbolic(x, held, self.parameters, time))
        self._asked(time, float(rates[0] - rates[1]) / inverse)

    def _asked(self, time: float, force: float | None) -> object:
        try:
            return self.exchange(time, force)
        except Exception as error:  # whatever the user's own code raises
            what = f"raised {type(error).__name__} at {time:.6g} s: {error}"
            raise ApcError(Diagnostic("E976", SourceLocation("--device"), what)) from None
