"""Simulation settings: duration, seed, and integration method between events.

Takes: the text of an option or argument, such as `rk4:0.1ms`.
Gives: `Settings`; `Method`, `DEFAULT`, `parse_method`, `finer`, `check_step`.
Guarantees: two runs of one model with equal settings are identical; a step is an exact rational of a second.
Does not: integrate (see `propagate`, `flow`, `integrate`), or select signals (see `signals`).

    exact              the exact transition; refused where an equation is not linear
    rk4:STEP           the classical method of Runge and Kutta, of order 4
    semi-implicit:STEP velocities first, then positions with the new velocities, of order 1, as in
                       haptic rendering engines
    cvodes:RTOL        CVODES of SUNDIALS, variable order and step, to a relative tolerance

Steps end at every event, the last one before it shorter if necessary. By default linear equations use the
exact transition, and nonlinear ones CVODES.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.number_parsing import plain_float
from apc.compiler.wording import no_more

EXACT, RK4, SEMI_IMPLICIT, CVODES = "exact", "rk4", "semi-implicit", "cvodes"
WHERE_NEEDED = "exact where linear"
EXAMPLES = {EXACT: "exact", RK4: "rk4:0.1ms", SEMI_IMPLICIT: "semi-implicit:1ms", CVODES: "cvodes:1e-10"}
ORDERS = {RK4: 4, SEMI_IMPLICIT: 1}

# The default tolerance of CVODES for the error of each step. Over the hundreds to thousands of restarts of a
# run errors add up: to 200 times the tolerance in a soft contact, 900 times in a stiff one (see
# tests/bench/work_precision.py).
TOLERANCE = 1e-10
TIGHTEST, LOOSEST = 1e-12, 1e-2  # the comparison run, 100 times tighter, is the limit of double precision
TIGHTER = 100.0
MOST_STEPS = 10**6  # between two events


@dataclass(frozen=True, slots=True)
class Method:
    """An integration method: `step` in seconds for a fixed step, `tolerance` (relative) for CVODES.

    `perturbed` states that every coefficient of the transitions is changed by one rounding, to estimate the
    effect of rounding.
    """

    name: str
    step: Fraction | None = None
    tolerance: float | None = None
    perturbed: bool = False

    def __str__(self) -> str:
        """Return the method in command-line notation."""
        if self.step is not None:
            return f"{self.name}:{1000 * float(self.step):g} ms"
        if self.name == CVODES:
            return f"{self.name}:{self.tolerance:g}"
        return self.name


DEFAULT = Method(WHERE_NEEDED, tolerance=TOLERANCE)


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a simulation.

    `duration` is in seconds; the last row is that of the last tick within it. `method` is the integration
    method between events; `seed` is the seed of random losses, None for that of the experiment; `jit` states
    whether to compile to machine code if a C compiler exists.
    """

    duration: Fraction
    method: Method = DEFAULT
    seed: int | None = None
    jit: bool = True


def parse_method(text: str) -> Method:
    """Return the integration method of a text such as "rk4:0.1 ms".

    Parameters
    ----------
    text
        A text such as "exact", "rk4:0.1 ms", "semi-implicit:1ms" or "cvodes:1e-8".

    Raises
    ------
    ApcError
        E910 an unknown method, E911 an invalid step, E912 an invalid tolerance.
    """
    name, colon, size = (part.strip() for part in text.partition(":"))
    location = SourceLocation("--method")
    if name not in EXAMPLES:
        nearest_name = nearest(name, EXAMPLES) or EXACT
        expected = f"one of {', '.join(EXAMPLES)}"
        got = text[:80] or "nothing"
        raise ApcError(Diagnostic("E910", location, "method", expected, got, EXAMPLES[nearest_name]))
    if name == EXACT:
        if colon:
            expected = "exact without a step"
            raise ApcError(Diagnostic("E910", location, "method", expected, text[:80], EXACT))
        return Method(EXACT)
    if name == CVODES:
        return Method(CVODES, tolerance=_tolerance(size, location))
    # Imported here: the language of quantities, which most runs do not need.
    from apc.compiler.language.units import quantity

    if not size:
        expected = "a step"
        raise ApcError(Diagnostic("E911", location, name, expected, "none", EXAMPLES[name]))
    try:
        step = Fraction(quantity(size, location, subject=f"step of {name}", unit="s").value)
    except ApcError as error:
        raise ApcError([replace(mistake, fix=EXAMPLES[name]) for mistake in error.mistakes]) from None
    if step <= 0:
        expected, got = "more than 0 s", size[:80]
        raise ApcError(Diagnostic("E911", location, f"step of {name}", expected, got, EXAMPLES[name]))
    return Method(name, step=step)


def _tolerance(text: str, location: SourceLocation) -> float:
    """Return the tolerance of a text; an error E912 if it is no number or out of range."""
    try:
        value = plain_float(text)
    except ValueError:
        value = 0.0
    if not TIGHTEST <= value <= LOOSEST:
        expected = f"a number from {TIGHTEST:g} to {LOOSEST:g}"
        message, got = "relative tolerance of cvodes", text[:80] or "none"
        raise ApcError(Diagnostic("E912", location, message, expected, got, EXAMPLES[CVODES]))
    return value


def check_step(model: Model, method: Method, fastest: Fraction, longest: Fraction) -> None:
    """Raise E913 for a fixed step that is longer than the fastest clock's period, or far too short.

    Parameters
    ----------
    model
        The model.
    method
        The method.
    fastest
        The period of the fastest clock, in seconds.
    longest
        The longest time between two events, in seconds.

    Raises
    ------
    ApcError
        E913 the step is longer than the fastest clock's period, or far too short.
    """
    if method.step is None:
        return
    location, message = SourceLocation(model.origin.topology), f"step of {method.name}"
    if method.step > fastest:
        expected = f"at most the period of the fastest clock, {_ms(fastest)}"
        fix = f"--method {method.name}:{no_more(1000 * fastest)}ms"
        raise ApcError(Diagnostic("E913", location, message, expected, _ms(method.step), fix))
    if longest / method.step > MOST_STEPS:
        expected = f"at least {_ms(longest / MOST_STEPS)}, a millionth of the time between two events"
        raise ApcError(Diagnostic("E913", location, message, expected, _ms(method.step)))


def _ms(seconds: Fraction) -> str:
    """Return a time as text in milliseconds."""
    return f"{1000 * float(seconds):g} ms"


def finer(method: Method, *, all_linear: bool) -> tuple[Method, float]:
    """Return a more accurate method, and the ratio of the error to the difference between the two methods.

    Halving the step of a method of order n leaves 1/2ⁿ of the error, so that the error is 1/(1 − 1/2ⁿ) of the
    difference (Richardson). A hundredth of the tolerance leaves a negligible part of the error.

    Parameters
    ----------
    method
        The method whose error is estimated.
    all_linear
        Whether all equations of the model are linear between the ticks.
    """
    if method.step is not None:
        return replace(method, step=method.step / 2), 1 / (1 - 0.5 ** ORDERS[method.name])
    if method.name == EXACT or (method.name == WHERE_NEEDED and all_linear):
        return replace(method, perturbed=True), 1.0
    assert method.tolerance is not None
    return replace(method, tolerance=method.tolerance / TIGHTER), 1.0
