"""All peers' frames in machine code: the kernels as loops over peers, and the engine that plays them.

Takes: a `Population`, the laws of its unreliable links.
Gives: `library_of`, `Library`, `Machine`; `program_text`, the C text; `Kernel`; `straight_lines`,
`luck_text`, `DISTRIBUTIONS`.
Guarantees: the numbers of `stepwise` to a few roundings of the sums, and the same packets; the text depends
on what a peer does in a frame, not on how many peers there are or on their numbers.
Does not: compile (see `native`), or play kernels that are not straight code, such as solvers.

C, and not numba or LLVM: its compiler is of the machine, where these would be further packages to install.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.interpolation import table_of
from apc.compiler.plain import PlainFunction, straight
from apc.network.channel import luck_key
from apc.network.timetable import START, Luck
from apc.simulation.hearing import Complete, Deliver, Look, OnWays, Operation, Sparse, Total, Weighed
from apc.simulation.native import native
from apc.simulation.population import Played, Population

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

# More operations and rows of tables than this in one kernel: to optimize straight code takes more than linear
# time.
MOST_OPERATIONS = 20_000
MANY = 32  # peers of a member from which on their loop is put into lanes
KINDS = ("total", "complete", "weighed", "deliver", "on ways", "copy", "copy ways", "look", "move", "work")
OPERATORS = {"sum": 0, "mean": 0, "max": 1, "min": 2}
DISTRIBUTIONS = {"uniform": 0, "normal": 1, "pareto": 2}

HEAD = """\
#include <math.h>
#include <stdint.h>
#include <string.h>
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
whole n, double *carry, const double *heard, const double *constants, {own}const double *impulses,
    whole sites, const whole *site, double frame, double *sent, const whole *keys, whole peers, double *rows,
    whole width"""
LOOKED = """\
whole arcs, const whole *senders, const whole *receivers, const double *weights, int mode,
    const whole *own, double *out, whole n, const double *sent, whole width, const double *missing,
    double t"""

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
    # As C's fmin and fmax, which take the other for what is no number, in a form that goes into lanes.
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
# In the table t with its last row: the row before `at`, by halving, and what is made of it.
SOUGHT = """\
int low{k} = 0, high{k} = {last};
while (high{k} - low{k} > 1) {{
  const int middle = low{k} + (high{k} - low{k}) / 2;
  if ({at} < times{t}[middle]) high{k} = middle; else low{k} = middle;
}}
const double rate{k} = (numbers{t}[high{k}] - numbers{t}[low{k}]) / (times{t}[high{k}] - times{t}[low{k}]);
"""
LOOKED_UP = {
    "interpolate": "const double {v} = {at} < times{t}[0] ? numbers{t}[0] : {at} >= times{t}[{last}] ? "
    "numbers{t}[{last}] : numbers{t}[low{k}] + rate{k} * ({at} - times{t}[low{k}]);",
    "slope": "const double {v} = {at} < times{t}[0] || {at} >= times{t}[{last}] ? 0.0 : rate{k};",
}


def _fields(*columns: tuple[str, str]) -> np.dtype[Any]:
    """Return a structure of `engine.c`: names of fields with their type, all of 8 bytes."""
    return np.dtype([(name, type_) for names, type_ in columns for name in names.split()])


WHOLE, NUMBER, ADDRESS = "i8", "f8", "u8"
ROUTE = _fields(
    ("ways runs slots ticks phase period first_tick tick_period kept buckets newest zero channels", WHOLE),
    ("distribution traced stride", WHOLE),
    ("p r one_minus_h one_minus_k bad_share jitter quantum", NUMBER),
    ("trace delays nominal senders receivers columns keys held effective gap bad", ADDRESS),
    ("heads queue when places arrived waits key0 key1", ADDRESS),
    ("heard", WHOLE),
)
MEMBER = _fields(
    ("count column recorded sites own impulse_rows", WHOLE), ("carry heard constants impulses site", ADDRESS)
)
OPERATION = _fields(("kind a b c d e f g", WHOLE), ("x y z", NUMBER), ("p q u v w", ADDRESS))
PLAN = _fields(
    ("runs frames_kept keys peers operations routes marks width parts frame", WHOLE),
    ("packets totals operation route member", ADDRESS),
)


@dataclass(frozen=True, slots=True)
class Kernel:
    """A segment's function (see `program`) as plain data, and how many signals it records at a mark."""

    function: PlainFunction
    recorded: int


def program_text(kernels: Sequence[Kernel], looks: Sequence[PlainFunction]) -> str:
    """Return the C text that plays members whose segments are these kernels, and looks at pairs so.

    Parameters
    ----------
    kernels
        The segments' kernels.
    looks
        The functions of pairs (see `pairs`).
    """
    parts = [HEAD]
    parts += [_kernel(place, one) for place, one in enumerate(kernels)]
    parts += [_look(place, one) for place, one in enumerate(looks)]
    parts.append(_table("kernels", "kernel", PARAMETERS.format(own="int own, "), len(kernels)))
    parts.append(_table("looks", "look", LOOKED, len(looks)))
    parts += [luck_text(), Path(__file__).with_name("engine.c").read_text(encoding="utf-8")]
    return "\n".join(parts)


def luck_text() -> str:
    """Return the C text of the luck of packets."""
    return Path(__file__).with_name("luck.c").read_text(encoding="utf-8")


def _table(name: str, each: str, parameters: str, count: int) -> str:
    listed = ", ".join(f"{each}{place}" for place in range(count)) or "0"
    return f"static void (*const {name}[])({parameters}) = {{{listed}}};\n"


def _kernel(place: int, kernel: Kernel) -> str:
    """Return a segment's kernel as a loop over peers."""
    function, recorded = kernel.function, kernel.recorded
    carry, heard, constants, impulses, _ = (rows for _, rows in function.inputs)
    inputs = [
        *(f"carry[{k} * n + i]" for k in range(carry)),
        *(f"heard[{k} * n + i]" for k in range(heard)),
        *(f"constants[own ? {k} * n + i : {k}]" for k in range(constants)),
        *(f"impulses[{k} * sites + site[i]]" for k in range(impulses)),
        "frame",
    ]
    after, sent, rows = function.results
    values, lines = straight_lines(function, inputs)
    stores = [f"carry[{k} * n + i] = {values[one]};" for k, one in enumerate(after)]
    stores += [f"sent[keys[{k}] * peers + i] = {values[one]};" for k, one in enumerate(sent)]
    stores += [
        f"rows[{k // recorded} * width + {k % recorded} * n + i] = {values[one]};"
        for k, one in enumerate(rows)
    ]
    body = "\n    ".join([*lines, *stores])
    given = "n, carry, heard, constants, {}impulses, sites, site, frame, sent, keys, peers, rows, width"
    return f"""\
INSIDE void inside{place}({PARAMETERS.format(own="const int own, ")}) {{
  LANES
  for (whole i = 0; i < n; i++) {{
    {body}
  }}
}}
CLONES static void kernel{place}({PARAMETERS.format(own="int own, ")}) {{
#ifdef MANY
  if (own) inside{place}({given.format("1, ")});
  else inside{place}({given.format("0, ")});
#else
  inside{place}({given.format("own, ")});
#endif
}}
"""


def _look(place: int, function: PlainFunction) -> str:
    """Return a function of pairs as a loop over arcs, and what their values are joined to."""
    own, sent, _, _ = (rows for _, rows in function.inputs)
    inputs = [
        *(f"((const double *)own[{2 * k}])[own[{2 * k + 1}] * r]" for k in range(own)),
        *(f"sent[{k} * width + s]" for k in range(sent)),
        "missing[s]",
        "t",
    ]
    values, lines = straight_lines(function, inputs)
    body = "\n    ".join(lines)
    return f"""\
static void look{place}({LOOKED}) {{
  for (whole r = 0; r < n; r++) out[r] = mode == 0 ? 0.0 : mode == 1 ? -INFINITY : INFINITY;
  for (whole a = 0; a < arcs; a++) {{
    const whole s = senders[a], r = receivers[a];
    {body}
    const double value = {values[function.results[0][0]]};
    out[r] = mode == 0 ? out[r] + weights[a] * value : mode == 1 ? fmax(out[r], value) : fmin(out[r], value);
  }}
}}
"""


def straight_lines(function: PlainFunction, inputs: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the names of a function's values, and the lines of C that make them."""
    used = {place for _, *places in function.operations for place in places}
    used |= {place for places in function.results for place in places}
    names, lines = [], []
    for place, text in enumerate(inputs):
        names.append(f"v{place}")
        if place in used:
            lines.append(f"const double v{place} = {text};")
    names += [_number(one) for one in function.constants]
    for table in function.tables:
        names.append(f"{len(names)}")
        for what, column in (("times", table.times), ("numbers", table.numbers)):
            listed = ", ".join(map(_number, column.tolist()))
            lines.append(f"static const double {what}{names[-1]}[{len(column)}] = {{{listed}}};")
    for word, *places in function.operations:
        name = f"v{len(names)}"
        if word in LOOKED_UP:
            table, at = (names[place] for place in places)
            rows = len(function.tables[places[0] - len(inputs) - len(function.constants)].times)
            text = SOUGHT + LOOKED_UP[word]
            lines += text.format(v=name, k=len(names), at=at, t=table, last=rows - 1).splitlines()
            names.append(name)
            continue
        form = EXPRESSIONS.get(word, f"{word}({', '.join(f'{{{k}}}' for k in range(len(places)))})")
        lines.append(f"const double {name} = {form.format(*(names[place] for place in places))};")
        names.append(name)
    return names, lines


def _number(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    return f"({value.hex()})" if math.copysign(1.0, value) < 0 else value.hex()


@dataclass(frozen=True, slots=True, eq=False)
class Library:
    """The compiled text of a population; `kernels` are the places of the segments' kernels, by their `id`."""

    loaded: ctypes.CDLL
    kernels: Mapping[int, int]


def library_of(population: Population, runs: int = 1) -> Library | None:
    """Return what plays a population in machine code, None where that can't be had.

    Parameters
    ----------
    population
        All peers.
    runs
        How many runs stand side by side.
    """
    segments = {id(one): (one, m.program) for m in population.members for one in m.program.segments}
    functions = [one.kernel for one, _ in segments.values()]
    looks = list(population.hearing.functions)
    if ctypes.sizeof(ctypes.c_void_p) != 8 or not all(_is_worth_it(one) for one in (*functions, *looks)):
        return None
    kernels = [Kernel(straight(one.kernel), len(own.recorded)) for one, own in segments.values()]
    many = runs * max(member.count for member in population.members) >= MANY
    loaded = native(program_text(kernels, [straight(one) for one in looks]), many=many)
    if loaded is None:
        return None
    return Library(loaded, {key: place for place, key in enumerate(segments)})


def _is_worth_it(function: Any) -> bool:
    if not function.is_a("SXFunction"):
        return False
    rows = sum(len(table_of(one).times) for one in function.find_functions(0))
    return bool(function.n_instructions() + rows <= MOST_OPERATIONS)


class Machine:
    """The memory of all peers, once for each of the runs side by side, and the library that plays them."""

    def __init__(
        self, library: Library, population: Population, lucks: Sequence[Luck], seed: int, runs: int
    ) -> None:
        """Lay out the memory.

        Parameters
        ----------
        library
            The population's.
        population
            All peers.
        lucks
            What chance does on each of its routes.
        seed
            The experiment's.
        runs
            How many runs stand side by side.
        """
        self.runs = runs
        self.population, self.lucks, self.seed, self.kernels = population, lucks, seed, library.kernels
        self._play = library.loaded.play
        self._play.argtypes = [
            ctypes.c_void_p,
            ctypes.c_int64,
            ctypes.c_int64,
            ctypes.c_void_p,
            ctypes.c_void_p,
        ]
        self._kept: list[NDArray[Any]] = []  # arrays whose addresses the library knows
        self._start: list[tuple[NDArray[Any], NDArray[Any] | float]] = []  # what changes, and its beginning
        hearing = population.hearing
        start = np.repeat(hearing.start, runs, axis=1)
        self.packets = self._changing(np.broadcast_to(start, (hearing.ring, *start.shape)))
        self.carries = [self._changing(self._carry(g)) for g in range(len(population.members))]
        self.heard = [
            self._own(
                np.zeros((max(s.kernel.numel_in("heard") for s in one.program.segments), one.count * runs))
            )
            for one in population.members
        ]
        self.members = self._own(np.array([self._member(g) for g in range(len(population.members))], MEMBER))
        self.routes = self._own(np.array([self._route(i) for i in range(len(lucks))], ROUTE))
        listed = [one for index, some in enumerate(hearing.segments) for one in self._segment(index, some)]
        operations = self._own(np.array([*self._work(), *listed], OPERATION))
        self.plan = self._own(np.zeros(1, PLAN))
        totals = self._own(np.zeros(max(hearing.totals, 1) * runs))
        self._set(
            self.plan[0],
            runs=runs,
            frames_kept=hearing.ring,
            keys=len(hearing.keys),
            peers=start.shape[1],
            operations=len(operations),
            routes=len(lucks),
            marks=population.marks,
            width=population.width * runs,
            parts=len(population.parts),
            frame=population.frame,
            packets=self.packets,
            totals=totals,
            operation=operations,
            route=self.routes,
            member=self.members,
        )
        self.address = self.plan.ctypes.data
        self.rows = self.work = np.empty((0, 0))  # of the last call
        self.begin(0)

    def begin(self, run: int) -> None:
        """Go back to time 0 (see `Player`)."""
        for array, value in self._start:
            array[...] = value
        for place, route in enumerate(self.population.hearing.routes):
            self.routes["key0"][place], self.routes["key1"][place] = luck_key(route.link, self.seed, run)
        self.routes["heard"] = 0

    def play(self, first: int, count: int, pushes: Sequence[Floats | None]) -> Played:
        """Play the frames from number `first` on (see `Player`)."""
        population = self.population
        for g, one in enumerate(pushes):
            if one is not None:
                self.members["impulses"][g] = one.ctypes.data
        if len(self.work) != count:
            self.rows = np.empty((count * population.marks, population.width * self.runs))
            self.work = np.empty((count, len(population.parts)))
        self.work[:] = 0.0
        failed = self._play(self.address, first, count, self.rows.ctypes.data, self.work.ctypes.data)
        assert not failed, "a packet is later than the latest can be"
        return Played(self.rows, self.work, count)

    def in_range(self) -> Flags:
        """Say of each run whether all that moves is still a number (see `Player`)."""
        moving = (
            carry[: member.program.layout.work.start]
            for carry, member in zip(self.carries, self.population.members, strict=True)
        )
        columns = [one.reshape(-1, self.runs) for one in (self.packets, *moving)]
        found: Flags = np.logical_and.reduce([np.isfinite(one).all(axis=0) for one in columns])
        return found

    # ---- the layout

    def _own(self, array: NDArray[Any]) -> NDArray[Any]:
        """Keep an array, contiguous, as long as the library may look at it."""
        self._kept.append(np.ascontiguousarray(array))
        return self._kept[-1]

    def _changing(self, start: NDArray[Any] | tuple[tuple[int, ...], Any, float]) -> NDArray[Any]:
        """Return an array that begins every run as it is given: whole, or (shape, type, number)."""
        if isinstance(start, tuple):
            shape, type_, value = start
            array = self._own(np.full(shape, value, type_))
            self._start.append((array, value))
            return array
        array = self._own(np.array(start))
        self._start.append((array, start))
        return array

    @staticmethod
    def _set(record: Any, **fields: Any) -> None:
        for name, value in fields.items():
            record[name] = value.ctypes.data if isinstance(value, np.ndarray) else value

    def _carry(self, g: int) -> Floats:
        member = self.population.members[g]
        height = max(
            max(one.kernel.numel_in("carry"), one.kernel.numel_out("carry_after"))
            for one in member.program.segments
        )
        start = np.zeros((height, member.count))
        start[: member.carry.shape[1]] = member.each(member.carry).T
        return self._side_by_side(start)

    def _side_by_side(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values (…, peers), or of ways, for every run: (…, peers · runs)."""
        return np.repeat(values, self.runs, axis=-1)

    def _member(self, g: int) -> Any:
        member = self.population.members[g]
        constants, sites = member.constants, len(member.parameters)
        record = np.zeros(1, MEMBER)[0]
        self._set(
            record,
            count=member.count * self.runs,
            column=int(self.population.hearing.first[g]) * self.runs,
            recorded=len(member.program.recorded),
            sites=sites,
            own=int(sites > 1),
            impulse_rows=member.program.impulse_rows,
            carry=self.carries[g],
            heard=self.heard[g],
            constants=self._own(self._side_by_side(member.each(constants).T) if sites > 1 else constants[0]),
            site=self._own(self._side_by_side(member.rows)),
        )
        return record

    def _route(self, place: int) -> Any:
        hearing, luck = self.population.hearing, self.lucks[place]
        route, law = hearing.routes[place], luck.law
        ways = len(route.pairs) * self.runs
        kept, buckets = luck.kept(route), luck.buckets(route)
        stride = ways + min(ways, buckets)  # a packet of each way, and where each run of them begins
        trace = np.zeros(0) if law.trace is None else law.trace
        record = np.zeros(1, ROUTE)[0]
        self._set(
            record,
            ways=len(route.pairs),
            runs=self.runs,
            slots=route.slots,
            ticks=route.ticks,
            phase=luck.phase,
            period=luck.period,
            first_tick=luck.tick_phase,
            tick_period=luck.tick_period,
            kept=kept,
            buckets=buckets,
            newest=int(luck.newest),
            zero=int(route.zero),
            channels=len(hearing.channels[place]),
            distribution=DISTRIBUTIONS[law.distribution],
            traced=len(trace),
            p=law.p,
            r=law.r,
            one_minus_h=law.one_minus_h,
            one_minus_k=law.one_minus_k,
            bad_share=law.bad,
            jitter=law.jitter,
            quantum=float(luck.quantum),
            trace=self._own(trace),
            delays=self._own(luck.delays),
            nominal=self._own(luck.nominal),
            senders=self._own(route.pairs[:, 0]),
            receivers=self._own(route.pairs[:, 1]),
            columns=self._own(self._columns(hearing.column_of[route.pairs[:, 0]]).astype(np.int32)),
            keys=self._own(hearing.channels[place]),
            held=self._changing(self._side_by_side(hearing.held[place])),
            effective=self._changing(((ways,), np.int64, START)),
            gap=self._changing(((ways,), np.int64, START)),
            bad=self._changing(((ways,), np.int8, 0)),
            heads=self._changing(((buckets,), np.int32, -1)),
            stride=stride,
            queue=self._own(np.empty((kept, stride), np.int32)),
            when=self._own(np.empty(ways, np.int32)),
            places=self._own(np.zeros(buckets, np.int32)),
        )
        if not luck.newest:
            record["arrived"] = self._changing(((ways,), np.int64, -1)).ctypes.data
            record["waits"] = self._own(np.empty((kept, ways), np.int64)).ctypes.data
        return record

    def _columns(self, places: Integers) -> Integers:
        """Return where the numbers of some peers or ways stand, run by run."""
        return (places[:, None] * self.runs + np.arange(self.runs)).reshape(-1)

    def _operation(self, kind: str, *whole: int, **fields: Any) -> Any:
        record = np.zeros(1, OPERATION)[0]
        self._set(record, kind=KINDS.index(kind), **dict(zip("abcdefg", whole, strict=False)), **fields)
        return record

    def _work(self) -> list[Any]:
        """Return what adds up the work done until a frame begins."""
        return [
            self._operation(
                "work", g, self.population.parts.index(part), member.program.layout.work.start + row
            )
            for g, member in enumerate(self.population.members)
            for row, part in enumerate(member.program.layout.parts)
        ]

    def _segment(self, index: int, operations: Sequence[Operation]) -> list[Any]:
        """Return what is done in a segment of all members."""
        found = [one for operation in operations for one in self._heard(operation)]
        population = self.population
        for g, member in enumerate(population.members):
            program = member.program
            before = program.segments[:index]
            recorded = max(len(program.recorded), 1)
            marks = sum(one.kernel.numel_out("rows") for one in before) // recorded
            pushed = sum(one.kernel.numel_in("impulses") for one in before)
            keys = np.array(
                [population.hearing.sent[g][row] for row in program.segments[index].sent], np.int64
            )
            kernel = self.kernels[id(program.segments[index])]
            where = (g, kernel, marks, population.columns[g] * self.runs, pushed)
            found.append(self._operation("move", *where, p=self._own(keys)))
        return found

    def _heard(self, one: Operation) -> list[Any]:
        match one:
            case Total(place, key, lag, ranges):
                listed = self._own(np.array(ranges, np.int64))
                return [self._operation("total", place, key, lag, len(ranges), p=listed)]
            case Complete(g, row, total, key, lag, divisor):
                return [self._operation("complete", g, total, key, lag, x=divisor, v=self.heard[g][row])]
            case Weighed(g, row, key, lag, weights):
                fields = self._weights(weights)
                return [self._operation("weighed", g, key, lag, v=self.heard[g][row], **fields)]
            case Deliver(route, tick):
                return [self._operation("deliver", route, tick)]
            case OnWays(g, row, route, channel, gap, weights):
                fields = self._weights(weights)
                alike = bool(len(weights.weights)) and bool((weights.weights == weights.weights[0]).all())
                side = bool((np.diff(weights.columns) == 1).all())
                same = int(alike and side)
                where = (g, route, 0, channel, int(gap), same)
                weight = float(weights.weights[0]) if same else 0.0
                return [self._operation("on ways", *where, x=weight, v=self.heard[g][row], **fields)]
        return self._look(one)

    def _weights(self, weights: Sparse) -> dict[str, NDArray[Any]]:
        return {
            "p": self._own(weights.starts),
            "q": self._own(weights.columns),
            "u": self._own(weights.weights),
        }

    def _look(self, one: Look) -> list[Any]:
        """Return what copies the packets that are looked at side by side, and looks at them."""
        member, runs = self.population.members[one.member], self.runs
        count = member.count * runs
        height = len(one.channels) if one.route >= 0 else len(one.sources)
        width = one.width * runs
        inside = self._own(np.zeros((height + 1, width)))  # what is heard, then what is missing
        found = []
        for row, source in zip(inside, one.sources, strict=False):
            to = 0
            for key, lag, ranges in source:
                for begin, end in ranges:
                    size = (end - begin) * runs
                    found.append(self._operation("copy", key, lag, begin * runs, size, v=row[to:]))
                    to += size
        if one.route >= 0:
            every = [*one.channels, -1] if one.gap else one.channels
            for row, channel in zip((*inside[: len(one.channels)], inside[-1]), every, strict=False):
                found.append(self._operation("copy ways", one.route, channel, v=row))
        carry, constants = self.carries[one.member], int(self.members["constants"][one.member])
        own = len(member.parameters) > 1
        rows = [(carry[row].ctypes.data, 1) for row in one.pairwise.carry]
        rows += [(constants + 8 * row * (count if own else 1), int(own)) for row in one.pairwise.constants]
        listed = np.concatenate([self._columns(one.receivers), np.array(rows, np.int64).reshape(-1)])
        schedule = member.program.schedule
        arcs = len(one.senders) * runs
        where = (one.member, one.function, arcs, OPERATORS[one.operator], width, height)
        found.append(
            self._operation(
                "look",
                *where,
                one.pairwise.now,
                y=float(schedule.quantum.numerator),
                z=float(schedule.quantum.denominator),
                p=self._own(self._columns(one.senders)),
                q=self._own(listed),
                u=self._own(self._side_by_side(one.weights)),
                v=inside,
                w=self.heard[one.member][one.row],
            )
        )
        return found
