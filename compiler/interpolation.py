"""Tables over time as CasADi functions, and back; a table's value and slope of any kind of number.

Takes: the rows of a table. Gives: `Interpolation`; `function_of`, `table_of`, `TABLE`;
`jacobian`.
Guarantees: straight lines between rows, the first and the last number before and after; a row is found by
halving, and what a function holds of a table is as long as the table. A derivative of any order is the slope
of the line times what it is a derivative by.
Does not: know where a table came from (see `recordings`), or when it is read.
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
    """Straight lines between rows: `times` (n,), rising, and `numbers` (n,) at them, n two or more."""

    times: Floats
    numbers: Floats

    @property
    def rates(self) -> Floats:
        """The slopes of its lines, 0 before the first row and after the last (n + 1,)."""
        return np.pad(np.diff(self.numbers) / np.diff(self.times), 1)

    def value(self, at: Any, number: Callable[[float], Any] = float) -> Any:
        """Return the value of the table at a number of some type; `number` converts floats to it."""
        index = bisect.bisect_right(self.times, float(at))
        low, start = (number(float(values[max(index - 1, 0)])) for values in (self.numbers, self.times))
        return low + self.slope(at, number) * (at - start) if 0 < index < len(self.times) else low

    def slope(self, at: Any, number: Callable[[float], Any] = float) -> Any:
        """Return the derivative of that value."""
        index = bisect.bisect_right(self.times, float(at))
        if index in (0, len(self.times)):
            return number(0.0)
        columns = self.times, self.numbers
        (start, end), (low, high) = (
            map(number, column[index - 1 : index + 1].tolist()) for column in columns
        )
        return (high - low) / (end - start)

    def values(self, at: Any) -> Any:
        """Return the values of the table at floats, or at complex steps from them."""
        result = np.interp(np.real(at), self.times, self.numbers)
        return result + 1j * self.slopes(at) * np.imag(at) if np.iscomplexobj(at) else result

    def slopes(self, at: Any) -> Any:
        """Return the derivatives of those values."""
        return self.rates[np.searchsorted(self.times, np.real(at), side="right")]

    def positions(self) -> Interpolation:
        """Return the table of the number of passed rows: an integer at each row, and nowhere else."""
        gaps = np.diff(self.times)[[0, -1]]
        times = np.concatenate([self.times[:1] - gaps[:1], self.times, self.times[-1:] + gaps[1:]])
        count = len(self.times)
        return Interpolation(times, np.clip(np.arange(-1, count + 1), -0.5, count - 0.5))


def function_of(table: Interpolation) -> Any:
    """Return a table as the CasADi function of one number, which stays a call wherever it is used."""
    at = casadi.MX.sym("at")
    rows = casadi.MX(casadi.DM(np.array([table.times, table.numbers])))
    location = casadi.low(casadi.DM(table.times), at, {"lookup_mode": "binary"})
    start, end, low, high = (rows[i, location + k] for i in (0, 1) for k in (0, 1))
    within = casadi.fmin(casadi.fmax(at, table.times[0]), table.times[-1])
    value = low + (high - low) / (end - start) * (within - start)
    return casadi.Function(TABLE, [at], [value], {"never_inline": True})


def table_of(function: Any) -> Interpolation:
    """Return the table that a function of CasADi's looks up: one of `function_of`, or a derivative of it."""
    for item in (function, *function.find_functions()):
        for k in range(item.n_instructions()):
            if item.instruction_id(k) == casadi.OP_CONST:
                constant = item.instruction_MX(k).to_DM()
                if constant.size1() == 2:
                    times, numbers = np.asarray(constant)
                    return Interpolation(times, numbers)
    raise ValueError(f"{function.name()} is no table of ours")


def jacobian(values: Any, symbols: Any) -> Any:
    """Return the Jacobian of a column over symbols, where tables that depend on none of them are constant.

    In forward mode CasADi evaluates the derivative of every call, also in direction 0; in reverse mode only
    the required ones.
    """
    tabled = isinstance(values, casadi.SX) and casadi.Function(
        "every", casadi.symvar(values), [values]
    ).find_functions(0)
    return casadi.jacobian(values, symbols, {"helper_options": {"ad_weight": 1.0}} if tabled else {})
