"""Time series as CasADi functions and the reverse; value and slope of a time series for all number types.

Takes: the rows of a table. Gives: `Interpolation`; `function_of`, `table_of`, `TABLE`;
`jacobian`.
Guarantees: interpolation is linear between rows, constant before the first and after the last; rows are found
by bisection, and the size of a function is proportional to the table. A derivative is the slope of the line
times the derivative of the time.
Does not: read tables (see `recordings`).
"""

from __future__ import annotations

import bisect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TABLE = "table"  # the name of the function of a table; CasADi calls its derivatives fwd1_table and so on


@dataclass(frozen=True, slots=True, eq=False)
class Interpolation:
    """Linear interpolation between rows: increasing `times` (n,), and `numbers` (n,); n is at least two."""

    times: Floats
    numbers: Floats

    @property
    def rates(self) -> Floats:
        """The slopes of the lines (n + 1,): 0 before the first row and after the last."""
        return np.pad(np.diff(self.numbers) / np.diff(self.times), 1)

    def value(self, time: Any, number: Callable[[float], Any] = float) -> Any:
        """Return the value of the table at a time of some number type.

        `number` converts floats to this type.
        """
        index = bisect.bisect_right(self.times, float(time))
        low, start = (number(float(values[max(index - 1, 0)])) for values in (self.numbers, self.times))
        return low + self.slope(time, number) * (time - start) if 0 < index < len(self.times) else low

    def slope(self, time: Any, number: Callable[[float], Any] = float) -> Any:
        """Return the slope of the table at a time of some number type.

        `number` converts floats to this type.
        """
        index = bisect.bisect_right(self.times, float(time))
        if index in (0, len(self.times)):
            return number(0.0)
        columns = self.times, self.numbers
        (start, end), (low, high) = (
            map(number, column[index - 1 : index + 1].tolist()) for column in columns
        )
        return (high - low) / (end - start)

    def values(self, times: Any) -> Any:
        """Return the values of the table at times: floats, or complex numbers for complex-step
        derivatives.
        """
        result = np.interp(np.real(times), self.times, self.numbers)
        return result + 1j * self.slopes(times) * np.imag(times) if np.iscomplexobj(times) else result

    def slopes(self, times: Any) -> Any:
        """Return the slopes of the table at times."""
        return self.rates[np.searchsorted(self.times, np.real(times), side="right")]

    def positions(self) -> Interpolation:
        """Return the table of the number of passed rows, which is an integer exactly at each row."""
        gaps = np.diff(self.times)[[0, -1]]
        times = np.concatenate([self.times[:1] - gaps[:1], self.times, self.times[-1:] + gaps[1:]])
        count = len(self.times)
        return Interpolation(times, np.clip(np.arange(-1, count + 1), -0.5, count - 0.5))


def function_of(table: Interpolation) -> Any:
    """Return a table as a CasADi function of the time, which is never inlined."""
    time = casadi.MX.sym("at")
    rows = casadi.MX(casadi.DM(np.array([table.times, table.numbers])))
    location = casadi.low(casadi.DM(table.times), time, {"lookup_mode": "binary"})
    start, end, low, high = (rows[i, location + k] for i in (0, 1) for k in (0, 1))
    within = casadi.fmin(casadi.fmax(time, table.times[0]), table.times[-1])
    value = low + (high - low) / (end - start) * (within - start)
    return casadi.Function(TABLE, [time], [value], {"never_inline": True})


def table_of(function: Any) -> Interpolation:
    """Return the table inside a CasADi function: a function of `function_of`, or a derivative of it."""
    for item in (function, *function.find_functions()):
        for k in range(item.n_instructions()):
            if item.instruction_id(k) == casadi.OP_CONST:
                constant = item.instruction_MX(k).to_DM()
                if constant.size1() == 2:
                    times, numbers = np.asarray(constant)
                    return Interpolation(times, numbers)
    raise ValueError(f"{function.name()} is no table of ours")


def jacobian(values: Any, symbols: Any) -> Any:
    """Return the Jacobian of a column with respect to symbols, if necessary in reverse mode.

    In forward mode CasADi evaluates the derivative of every table, also in direction 0; in reverse mode only
    the required derivatives.
    """
    tabled = isinstance(values, casadi.SX) and casadi.Function(
        "every", casadi.symvar(values), [values]
    ).find_functions(0)
    return casadi.jacobian(values, symbols, {"helper_options": {"ad_weight": 1.0}} if tabled else {})
