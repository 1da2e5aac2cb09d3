"""All peers' frames in machine code: the kernels as loops over peers, and the engine that runs them.

Takes: a `Population`, the packets of its unreliable links.
Gives: `library_of`, `LoadedLibrary`, `CompiledEngine`; `program_text`, the C text; `straight_lines`.
Guarantees: results equal those of `interpreted_engine` to a few roundings of the sums; the text depends on
the operations of a peer in a frame, not on the number of peers or their parameters.
Does not: compile (see `c_compiler`), or run kernels that are not straight code, such as solvers.

C instead of numba or LLVM: a C compiler is usually installed, these would be further packages.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.expression_data import PlainFunction, straight
from apc.compiler.interpolation import table_of
from apc.simulation.c_compiler import native
from apc.simulation.exchange_program import (
    Arrived,
    CompleteGraphSum,
    Deliver,
    Operation,
    PairwiseReduction,
    Source,
    WeightedSum,
)
from apc.simulation.population import DeliverySource, FrameRows, Population, PopulationState
from apc.simulation.program import Segment

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Limit of operations and rows of tables in one kernel: the optimization of straight-line code takes more than
# linear time.
MOST_OPERATIONS = 20_000
MANY = 32  # least number of peers of a member for a vectorized loop
KINDS = ("complete", "weighed", "deliver", "look", "move", "work")
OPERATORS = {"sum": 0, "mean": 0, "max": 1, "min": 2}

HEAD = """\
#include <math.h>
#include <stdint.h>
typedef int64_t whole;
#if defined(_WIN32)
#define LIBRARY __declspec(dllexport)
#else
#define LIBRARY
#endif
/* No number of a peer depends on another peer's within a loop; loops for two generations of processors. */
#if defined(__clang__)
#define LANES _Pragma("clang loop vectorize(assume_safety)")
#define INSIDE static inline __attribute__((always_inline))
#define CLONES
#elif defined(__GNUC__)
#define LANES _Pragma("GCC ivdep")
#define INSIDE static inline __attribute__((always_inline))
#if defined(MANY) && defined(__x86_64__) && defined(__gnu_linux__)
#define CLONES __attribute__((target_clones("avx2", "default")))
#else
#define CLONES
#endif
#else
#define LANES
#define INSIDE static inline
#define CLONES
#endif
"""
PARAMETERS = """\
whole n, double *carry, const double *heard, const double *constants, {local}const double *impulses,
    whole sites, const whole *site, double frame, double *sent, const whole *keys, whole peers, double *rows,
    whole width"""
READ = """\
whole arcs, const whole *senders, const whole *receivers, const double *weights, int mode, int first,
    const whole *own, double *out, whole n, const double *const *sent, const double *missing, double t"""

EXPRESSIONS = {
    "neg": "-{0}",
    "sq": "{0} * {0}",
    "twice": "{0} + {0}",
    "inv": "1.0 / {0}",
    "sign": "{0} < 0 ? -1.0 : {0} > 0 ? 1.0 : {0}",
    "not": "!{0}",
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "constpow": "pow({0}, {1})",
    # C's fmin and fmax, which ignore a NaN, in a form that can be vectorized.
    "fmin": "{0} < {1} || {1} != {1} ? {0} : {1}",
    "fmax": "{0} > {1} || {1} != {1} ? {0} : {1}",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
    "and": "{0} && {1}",
    "or": "{0} || {1}",
    "if_else_zero": "{0} ? {1} : 0.0",
}
# Bisection for the row of the table t before `at`, and the slope there.
SOUGHT = """\
int low{k} = 0, high{k} = {last};
while (high{k} - low{k} > 1) {{
  const int middle = low{k} + (high{k} - low{k}) / 2;
  if ({at} < times{t}[middle]) high{k} = middle; else low{k} = middle;
}}
const double rate{k} = (numbers{t}[high{k}] - numbers{t}[low{k}]) / (times{t}[high{k}] - times{t}[low{k}]);
"""
READ_INDEXED = {
    "interpolate": "const double {v} = {at} < times{t}[0] ? numbers{t}[0] : {at} >= times{t}[{last}] ? "
    "numbers{t}[{last}] : numbers{t}[low{k}] + rate{k} * ({at} - times{t}[low{k}]);",
    "slope": "const double {v} = {at} < times{t}[0] || {at} >= times{t}[{last}] ? 0.0 : rate{k};",
}


def _fields(*columns: tuple[str, str]) -> np.dtype[Any]:
    """Return the data type of a structure of `engine.c`: field names with their type, each of 8 bytes."""
    return np.dtype([(name, type_) for names, type_ in columns for name in names.split()])


WHOLE, NUMBER, ADDRESS = "i8", "f8", "u8"
ROUTE = _fields(
    ("arcs slots ticks zero channels", WHOLE),
    ("columns keys held effective delivered missing", ADDRESS),
)
MEMBER = _fields(
    ("count column recorded subsystems local impulse_rows", WHOLE),
    ("carry received constants impulses subsystem", ADDRESS),
)
OPERATION = _fields(("kind a b c d e f g", WHOLE), ("x y z", NUMBER), ("p q u v r", ADDRESS))
PLAN = _fields(
    ("frames_kept keys peers operations samples width parts frame", WHOLE),
    ("packets operation route member", ADDRESS),
)


def program_text(kernels: Sequence[tuple[PlainFunction, int]], reads: Sequence[PlainFunction]) -> str:
    """Return the C text of the segments' kernels and the pairwise reductions, with the engine.

    Parameters
    ----------
    kernels
        The segments' kernels, each with the number of signals that it records at a sample time.
    reads
        The pairwise functions (see `pairwise`).
    """
    parts = [HEAD]
    parts += [_kernel(index, *kernel) for index, kernel in enumerate(kernels)]
    parts += [_reduce(index, reduction) for index, reduction in enumerate(reads)]
    parts.append(_table("kernels", "kernel", PARAMETERS.format(local="int own, "), len(kernels)))
    parts.append(_table("looks", "look", READ, len(reads)))
    parts.append(Path(__file__).with_name("engine.c").read_text(encoding="utf-8"))
    return "\n".join(parts)


def _table(name: str, prefix: str, parameters: str, count: int) -> str:
    """Return the C text of a table of function pointers."""
    listed = ", ".join(f"{prefix}{index}" for index in range(count)) or "0"
    return f"static void (*const {name}[])({parameters}) = {{{listed}}};\n"


def _kernel(index: int, function: PlainFunction, recorded: int) -> str:
    """Return the C text of a segment's kernel, a loop over peers."""
    carry, received, constants, impulses, _ = (rows for _, rows in function.inputs)
    inputs = [
        *(f"carry[{k} * n + i]" for k in range(carry)),
        *(f"heard[{k} * n + i]" for k in range(received)),
        *(f"constants[own ? {k} * n + i : {k}]" for k in range(constants)),
        *(f"impulses[{k} * sites + site[i]]" for k in range(impulses)),
        "frame",
    ]
    after, sent, rows = function.results
    values, lines = straight_lines(function, inputs)
    stores = [f"carry[{k} * n + i] = {values[value]};" for k, value in enumerate(after) if value != k]
    stores += [f"sent[keys[{k}] * peers + i] = {values[value]};" for k, value in enumerate(sent)]
    stores += [
        f"rows[{k // recorded} * width + {k % recorded} * n + i] = {values[value]};"
        for k, value in enumerate(rows)
    ]
    body = "\n    ".join([*lines, *stores])
    given = "n, carry, heard, constants, {}impulses, sites, site, frame, sent, keys, peers, rows, width"
    return f"""\
INSIDE void inside{index}({PARAMETERS.format(local="const int own, ")}) {{
  LANES
  for (whole i = 0; i < n; i++) {{
    {body}
  }}
}}
CLONES static void kernel{index}({PARAMETERS.format(local="int own, ")}) {{
#ifdef MANY
  if (own) inside{index}({given.format("1, ")});
  else inside{index}({given.format("0, ")});
#else
  inside{index}({given.format("own, ")});
#endif
}}
"""


def _reduce(index: int, function: PlainFunction) -> str:
    """Return the C text of a pairwise function, a loop over arcs that reduces the values at each receiver."""
    local, sent, _, _ = (rows for _, rows in function.inputs)
    inputs = [
        *(f"((const double *)own[{2 * k}])[own[{2 * k + 1}] * r]" for k in range(local)),
        *(f"sent[{k}][s]" for k in range(sent)),
        "(missing ? missing[s] : 0.0)",
        "t",
    ]
    values, lines = straight_lines(function, inputs)
    body = "\n    ".join(lines)
    return f"""\
static void look{index}({READ}) {{
  if (first) for (whole r = 0; r < n; r++) out[r] = mode == 0 ? 0.0 : mode == 1 ? -INFINITY : INFINITY;
  for (whole a = 0; a < arcs; a++) {{
    const whole s = senders[a], r = receivers[a];
    {body}
    const double value = {values[function.results[0][0]]};
    out[r] = mode == 0 ? out[r] + weights[a] * value : mode == 1 ? fmax(out[r], value) : fmin(out[r], value);
  }}
}}
"""


def straight_lines(function: PlainFunction, inputs: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the C names of a function's values, and the lines of C that compute them."""
    used = {index for _, *indices in function.operations for index in indices}
    used |= {index for indices in function.results for index in indices}
    names, lines = [], []
    for index, text in enumerate(inputs):
        names.append(f"v{index}")
        if index in used:
            lines.append(f"const double v{index} = {text};")
    names += [_number(constant) for constant in function.constants]
    for table in function.tables:
        names.append(f"{len(names)}")
        for subject, column in (("times", table.times), ("numbers", table.numbers)):
            listed = ", ".join(map(_number, column.tolist()))
            lines.append(f"static const double {subject}{names[-1]}[{len(column)}] = {{{listed}}};")
    for operation, *indices in function.operations:
        name = f"v{len(names)}"
        if operation in READ_INDEXED:
            table, argument = (names[index] for index in indices)
            table_rows = len(function.tables[indices[0] - len(inputs) - len(function.constants)].times)
            text = SOUGHT + READ_INDEXED[operation]
            lines += text.format(v=name, k=len(names), at=argument, t=table, last=table_rows - 1).splitlines()
            names.append(name)
            continue
        form = EXPRESSIONS.get(
            operation, f"{operation}({', '.join(f'{{{k}}}' for k in range(len(indices)))})"
        )
        lines.append(f"const double {name} = {form.format(*(names[index] for index in indices))};")
        names.append(name)
    return names, lines


def _number(value: float) -> str:
    """Return a float as an exact C literal."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    return f"({value.hex()})" if math.copysign(1.0, value) < 0 else value.hex()


@dataclass(frozen=True, slots=True, eq=False)
class LoadedLibrary:
    """The loaded library of a population.

    `kernels` are the indices of the segments' kernels by segment.
    """

    loaded: ctypes.CDLL
    kernels: Mapping[Segment, int]


def library_of(population: Population) -> LoadedLibrary | None:
    """Return the compiled library of a population, None if unavailable."""
    segments = {segment: m.program for m in population.members for segment in m.program.segments}
    functions = [segment.kernel for segment in segments]
    reads = list(population.exchange_program.functions)
    if ctypes.sizeof(ctypes.c_void_p) != 8 or not all(
        _is_compilable(function) for function in (*functions, *reads)
    ):
        return None
    kernels = [(straight(segment.kernel), len(program.recorded)) for segment, program in segments.items()]
    many = max(member.count for member in population.members) >= MANY
    loaded = native(program_text(kernels, [straight(reduction) for reduction in reads]), many=many)
    if loaded is None:
        return None
    return LoadedLibrary(loaded, {key: index for index, key in enumerate(segments)})


def _is_compilable(function: Any) -> bool:
    """Return whether a function is straight-line code with at most MOST_OPERATIONS operations and
    table rows.
    """
    if not function.is_a("SXFunction"):
        return False
    rows = sum(len(table_of(table).times) for table in function.find_functions(0))
    return bool(function.n_instructions() + rows <= MOST_OPERATIONS)


class CompiledEngine(PopulationState):
    """An engine that simulates all peers by compiled code, with their stored values."""

    def __init__(
        self,
        library: LoadedLibrary,
        population: Population,
        timetable: Callable[[int], DeliverySource] | None,
    ) -> None:
        """Set up the structures that the compiled code reads.

        Parameters
        ----------
        library
            The compiled library of the population.
        population, timetable
            As for `PopulationState`.
        """
        super().__init__(population, timetable)
        self._play = library.loaded.play
        self._play.argtypes = [ctypes.c_void_p, *[ctypes.c_int64] * 2, *[ctypes.c_void_p] * 2]
        self._stored: list[NDArray[Any]] = []  # arrays whose addresses the library uses
        exchange_program, members = population.exchange_program, population.members
        received_rows = [
            max(segment.kernel.numel_in("received") for segment in m.program.segments) for m in members
        ]
        self.received = [
            self._keep(np.zeros((row_count, member.count)))
            for row_count, member in zip(received_rows, members, strict=True)
        ]
        self.members = self._keep(
            np.array([self._member(member_index) for member_index in range(len(members))], MEMBER)
        )
        self.routes = self._keep(
            np.array([self._route(i) for i in range(len(exchange_program.routes))], ROUTE)
        )
        operations = [
            self._operation(
                "work", member_index, population.parts.index(part), member.program.layout.work.start + row
            )
            for member_index, member in enumerate(members)
            for row, part in enumerate(member.program.layout.parts)
        ]
        for index, exchange_operations in enumerate(exchange_program.segments):
            operations += [self._exchange_operation(operation) for operation in exchange_operations]
            operations += [
                self._propagation(member_index, index, library) for member_index in range(len(members))
            ]
        self.plan = self._keep(np.zeros(1, PLAN))
        _set(
            self.plan[0],
            frames_kept=exchange_program.ring,
            keys=len(exchange_program.keys),
            peers=exchange_program.start.shape[1],
            operations=len(operations),
            samples=population.sample_count,
            width=population.width,
            parts=len(population.parts),
            frame=population.frame,
            packets=self.packets,
            operation=self._keep(np.array(operations, OPERATION)),
            route=self.routes,
            member=self.members,
        )
        self.rows = self.work = np.empty((0, 0))  # of the last call

    def advance(self, first: int, count: int, pushes: Sequence[Floats | None]) -> FrameRows:
        """Simulate the frames from number `first` on (see `population.FrameEngine`)."""
        population = self.population
        for g, impulses in enumerate(pushes):
            if impulses is not None:
                self.members["impulses"][g] = impulses.ctypes.data
        observed = self.delivered_until(first + count)
        missing = [np.ascontiguousarray(route.missing) for route in observed]
        for index, route in enumerate(observed):
            self.routes["delivered"][index] = route.packets.ctypes.data
            self.routes["missing"][index] = missing[index].ctypes.data
        if len(self.work) != count:
            self.rows = np.empty((count * population.sample_count, population.width))
            self.work = np.empty((count, len(population.parts)))
        self.work[:] = 0.0
        addresses = self.rows.ctypes.data, self.work.ctypes.data
        self._play(self.plan.ctypes.data, first, count, *addresses)
        return FrameRows(self.rows, self.work, count)

    # ---- the layout

    def _keep(self, array: Any) -> NDArray[Any]:
        """Return an array as contiguous, stored as long as the library may read it."""
        self._stored.append(np.ascontiguousarray(array))
        return self._stored[-1]

    def _keep_integers(self, array: Any) -> Integers:
        """Return an array of integers as contiguous, stored as long as the library may read it."""
        return self._keep(np.asarray(array, np.int64))

    def _member(self, g: int) -> Any:
        """Return the structure of one member: its sizes and the addresses of its arrays."""
        member = self.population.members[g]
        subsystems = len(member.parameters)
        return _set(
            np.zeros(1, MEMBER)[0],
            count=member.count,
            column=int(self.population.exchange_program.first[g]),
            recorded=len(member.program.recorded),
            subsystems=subsystems,
            local=int(subsystems > 1),
            impulse_rows=member.program.impulse_rows,
            carry=self.carries[g],
            received=self.received[g],
            constants=self._keep(member.each(member.constants).T if subsystems > 1 else member.constants[0]),
            subsystem=self._keep_integers(member.rows),
        )

    def _route(self, index: int) -> Any:
        """Return the structure of a route: its sizes and the addresses of its arrays."""
        exchange_program = self.population.exchange_program
        route, keys = exchange_program.routes[index], exchange_program.channels[index]
        return _set(
            np.zeros(1, ROUTE)[0],
            arcs=len(route.pairs),
            slots=route.slots,
            ticks=route.ticks,
            zero=int(route.zero),
            channels=len(keys),
            columns=self._keep(exchange_program.column_of[route.pairs[:, 0]]),
            keys=self._keep(keys),
            held=self.held[index],
            effective=self.effective[index],
        )

    def _operation(self, kind: str, *whole: int, **fields: Any) -> Any:
        """Return the structure of an operation with integer arguments a to g and further fields."""
        record = np.zeros(1, OPERATION)[0]
        return _set(record, kind=KINDS.index(kind), **dict(zip("abcdefg", whole, strict=False)), **fields)

    def _propagation(self, g: int, index: int, library: LoadedLibrary) -> Any:
        """Return the operation that propagates a member over a segment."""
        population = self.population
        segment = population.members[g].program.segments[index]
        keys = self._keep_integers([population.exchange_program.sent[g][row] for row in segment.sent])
        location = (library.kernels[segment], segment.first_mark, population.columns[g])
        return self._operation("move", g, *location, segment.first_impulse, p=keys)

    def _source_location(self, source: Source) -> tuple[int, int, int]:
        """Return the location of a source: a packet's key and lag and 0, or −1, 0 and an address."""
        if isinstance(source, Arrived):
            return -1, 0, self.held[source.route][source.row].ctypes.data
        return source.key, source.lag, 0

    def _exchange_operation(self, operation: Operation) -> Any:
        """Return the structure of an operation of the packet exchange."""
        match operation:
            case CompleteGraphSum(g, row, packet, ranges, local, divisor):
                location = (g, packet.key, packet.lag, len(ranges), int(local))
                target = self.received[g][row]
                return self._operation(
                    "complete", *location, x=divisor, p=self._keep_integers(ranges), v=target
                )
            case WeightedSum(g, row, source, weights):
                fields = {
                    "p": self._keep_integers(weights.indptr),
                    "q": self._keep_integers(weights.indices),
                    "u": self._keep(weights.data),
                }
                key, lag, address = self._source_location(source)
                return self._operation("weighed", g, key, lag, r=address, v=self.received[g][row], **fields)
            case Deliver(route, tick):
                return self._operation("deliver", route, tick)
        return self._reduce(operation)

    def _reduce(self, reduction: PairwiseReduction) -> Any:
        """Return the structure of a pairwise reduction."""
        member = self.population.members[reduction.member]
        carry, constants = self.carries[reduction.member], int(self.members["constants"][reduction.member])
        own_constants = len(member.parameters) > 1
        rows = [(carry[row].ctypes.data, 1) for row in reduction.pairwise.carry]
        stride = 8 * (member.count if own_constants else 1)
        rows += [(constants + stride * row, int(own_constants)) for row in reduction.pairwise.constants]
        sources = [self._source_location(source) for source in reduction.sources]
        integer_data = [
            reduction.receivers,
            np.array(rows, np.int64).ravel(),
            np.array(sources, np.int64).ravel(),
        ]
        quantum = member.program.schedule.quantum
        arguments = (
            reduction.function,
            len(reduction.senders),
            OPERATORS[reduction.operator],
            int(reduction.first),
            len(sources),
        )
        return self._operation(
            "look",
            reduction.member,
            *arguments,
            reduction.pairwise.now,
            x=float(len(rows)),
            y=float(quantum.numerator),
            z=float(quantum.denominator),
            p=self._keep(reduction.senders),
            q=self._keep(np.concatenate(integer_data)),
            u=self._keep(reduction.weights),
            r=self._source_location(reduction.missing)[2] if reduction.missing else 0,
            v=self.received[reduction.member][reduction.row],
        )


def _set(record: Any, **fields: Any) -> Any:
    """Return a structure with its fields set to numbers, or to the addresses of arrays."""
    for name, value in fields.items():
        record[name] = value.ctypes.data if isinstance(value, np.ndarray) else value
    return record
