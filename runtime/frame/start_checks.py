"""Whether the equations of a scene have values where it starts, and its frame a finite map.

Takes: a `Model`. Gives: `check_values`.
Guarantees: what compiles can be linearized and lifted, or the message says what has no value.
Does not: bound the map's error (see `lift`).
"""

from __future__ import annotations

import numpy as np

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.frame.ages import linear_sites, of_one_delay
from apc.frame.discretize import TOO_LARGE, refuse_many
from apc.frame.finite_equations import finite_equations
from apc.frame.lift import lift
from apc.frame.linearize import check_start, linearize
from apc.frame.parameters import resolve
from apc.frame.scheduling import build_schedules
from apc.threads import single_threaded

# Sites of a kind that are checked: they differ in numbers only, which the functions take as they come.
MOST_CHECKED = 3


@part("check of values")
def check_values(system: Model) -> None:
    """Linearize and lift the first few sites of each kind; refuse the scene if a number is not finite.

    A kind whose slopes depend on what is heard is left to the analysis, which knows where the scene starts.
    Ages are those of each link's own delay: where delays differ from pair to pair, only an analysis refuses
    that, and a simulation needs no single age.

    Raises
    ------
    ApcError
        E806 a frame leaves the range of floats; E808 an equation has no finite value at the start values;
        E812 a peer has too many states.
    """
    place = SourceLocation(system.origin.topology)
    for kind in system.kinds:
        refuse_many(len(kind.states), place)
    numbers = resolve(system)
    sites = linear_sites(of_one_delay(system), numbers.timings)
    schedules = build_schedules(system, numbers.timings, [site.pattern for site in sites])
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        for group, schedule, rows in zip(system.groups, schedules, numbers.parameters, strict=True):
            if not sites[group.kind].parameters_suffice:
                continue
            for parameters in np.unique(rows[:MOST_CHECKED], axis=0):
                check_start(sites[group.kind], parameters)
                frame = lift(linearize(sites[group.kind], parameters), schedule)
                if not all(np.isfinite(block).all() for block in (frame.p, frame.q, frame.s, frame.d)):
                    raise ApcError(Diagnostic("E806", place, TOO_LARGE))
