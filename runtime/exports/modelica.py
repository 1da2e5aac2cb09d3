"""A model as one flat model of Modelica 3.3, its clocks as clocked partitions (chapter 16).

Takes: a `Model`. Gives: `modelica`, a `ModelicaModel`; `write_modelica`.
Guarantees: the equations are those that `apc simulate` integrates, not linearized. Packets are received, and
forces take effect, at the scheduled tick and instant; times are rationals. Constructs without a Modelica
equivalent are refused by name.
Does not: write files, or run the model.

    sampled    sample(x, clock)                   the value just before the tick, as in `simulate`
    force      hold(shiftSample(previous(f), …))  whole ticks of a delay by previous, the rest by shiftSample
    received   superSample(previous(sent), n)     if both clocks start together and the delay is whole ticks
    received   sample(hold(shiftSample(…)))       otherwise: available half a step of the grid of all times
                                                  early, so that a tick at the instant of arrival receives it,
                                                  as sample returns the value just before the tick
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from apc.compiler.compiled import ClockPartition, Model, Receive
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import write_text
from apc.compiler.weights import exact_weight
from apc.exports.expressions import (
    NONE,
    SUM,
    Text,
    identifier,
    number,
    result_texts,
    unit_of_modelica,
)
from apc.exports.identifiers import identifier as word
from apc.exports.peer_step import instant_functions, received_by
from apc.exports.texts import filled, quoted
from apc.lifting.data_age import stamped
from apc.linearization.evaluation_errors import finite_equations
from apc.linearization.jacobians import jacobians
from apc.linearization.linearize import start_sends
from apc.network.nominal_criterion import chance, unreliable
from apc.parameter_values.parameters import resolve
from apc.result import Result
from apc.simulation.trajectory import texts_of
from apc.support.distribution import program_version
from apc.timing.communication_graph import CommunicationGraph, build_comm_graph, check_mean

# The largest number of received terms and variables in a file; Modelica tools flatten each of them.
MOST_TERMS = 20_000

# Of a counter of a clock: Modelica's Integer has 32 bits in most tools.
LARGEST_COUNTER = 2**31 - 1

SECOND = Fraction(1)
TIME, ZERO = Text("time", unit="s"), number(0.0)


@dataclass(frozen=True, slots=True, eq=False)
class ModelicaModel(Result):
    """A model as Modelica text: its `name`, its `text`, and its contents.

    `clocks` are the lines that declare its clocks.
    """

    shown_by = "exports_output:modelica"

    topology: str
    name: str
    text: str
    peers: int
    variables: int
    clocks: tuple[str, ...]


def write_modelica(path: Path, modelica_model: ModelicaModel) -> None:
    """Write a model to a file. Raises ApcError (E601)."""
    write_text(path, modelica_model.text)


def modelica(model: Model) -> ModelicaModel:
    """Return a model as Modelica text.

    Parameters
    ----------
    model
        The model.

    Raises
    ------
    ApcError
        E955 a construct without a Modelica equivalent; E801, E802 an undefined mean.
    """
    with finite_equations(model):
        return _ModelicaWriter(stamped(model)).complete()


class _ModelicaWriter:
    """The text of a model: declarations and equations, added when they are needed."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.numbers = resolve(model)
        self.comm_graph: CommunicationGraph = build_comm_graph(model, self.numbers.timings)
        timing = self.numbers.timings
        self.grids = {clock.name: (timing[clock.period], timing[clock.phase]) for clock in model.clocks}
        self.clock_of = {link.name: link.clock for link in model.links}
        self.used: set[str] = set()
        self.parameters: dict[str, tuple[Text, str]] = {}
        self.declared: list[str] = []
        self.equations: list[str] = []
        _refuse_unsupported(model, self.comm_graph)
        self.clocks, self.clock_lines = self._clocks()
        self.named: dict[Any, Text] = {}  # variables that are declared once and used several times
        self.sent: dict[tuple[int, str], list[tuple[Text, str]]] = {}  # sent values, with their channels

    def complete(self) -> ModelicaModel:
        """Return the complete model."""
        model, name = self.model, identifier(word(self.model.name))
        groups = [g for g, group in enumerate(model.groups) for _ in range(group.count)]
        peers = [_Peer(self, number, group) for number, group in enumerate(groups)]
        for peer in peers:
            peer.declare()
        for peer in peers:
            self.comment(f"{peer.name}: states")
            rates = result_texts(peer.peer_type.derivative, [peer.x, peer.u, peer.p, [TIME]], peer.keep)
            for state, rate in zip(peer.x, rates, strict=True):
                self.define(f"der({state.text})", rate.text)
        for peer in peers:
            peer.sends()
        for peer in peers:
            for partition in peer.peer_type.clocks:
                peer.tick(partition)
        text = filled(
            "modelica.jinja",
            name=name,
            model=model,
            title=model.description or model.name,
            version=program_version(),
            texts=texts_of(model),
            parameters=[line for _, line in self.parameters.values()],
            clocks=self.clock_lines,
            declared=self.declared,
            equations=self.equations,
            duration=float(model.experiment.duration or SECOND),
            step=float(min((period for period, _ in self.grids.values()), default=SECOND / 1000)),
            description=f"The equations that apc compiled of {model.name}: all peers, every tick and packet.",
        )
        return ModelicaModel(
            topology=model.name,
            name=name,
            text=text.rstrip("\n"),
            peers=len(peers),
            variables=len(self.declared),
            clocks=tuple(line.strip() for line in self.clock_lines),
        )

    def name(self, requested: str) -> str:
        """Return a name that is not used yet, quoted if Modelica requires it."""
        requested = name = "".join(
            text if text.isascii() and text.isprintable() else "_" for text in requested
        )
        count = 1
        while name in self.used:
            count += 1
            name = f"{requested} ({count})"
        self.used.add(name)
        return identifier(name)

    def declare(
        self,
        name: str,
        unit: str = NONE,
        start: Text | None = None,
        *,
        fixed: bool = False,
        truth: bool = False,
    ) -> Text:
        """Declare a variable and return it.

        Parameters
        ----------
        name, unit
            The name in the model, and the unit in SI.
        start, fixed
            The start value, and whether it is fixed.
        truth
            Whether the variable is a Boolean.
        """
        if len(self.declared) >= MOST_TERMS:
            raise _refused(
                self.model, f"more than {MOST_TERMS:,} variables", "reduce the number of peers by --set"
            )
        variable, modelica_unit = self.name(name), unit_of_modelica(unit)
        modifiers = [f'unit="{modelica_unit}"'] if modelica_unit else []
        modifiers += [f"start={start.text}"] if start is not None else []
        modifiers += ["fixed=true"] if fixed else []
        listed = f"({', '.join(modifiers)})" if modifiers else ""
        self.declared.append(f"  {'Boolean' if truth else 'Real'} {variable}{listed};")
        return Text(variable, truth=truth, unit=unit, start=start)

    def let(self, name: str, value: str, unit: str, start: Text | None = None) -> Text:
        """Declare a variable, add the equation of its value, and return the variable."""
        variable = self.declare(name, unit, start)
        self.define(variable.text, value)
        return variable

    def like(self, variable: Text, name: str, value: str) -> Text:
        """Declare a variable with its value, and the unit and start of another variable; return it."""
        return self.let(name, value, variable.unit, variable.start)

    def define(self, variable: str, value: str) -> None:
        """Add the equation of a variable."""
        self.equations.append(f"  {variable} = {value};")

    def comment(self, text: str) -> None:
        """Add a comment between equations."""
        self.equations += ["", f"  // {text}"]

    def parameter(self, label: str, value: float, unit: str, description: str) -> Text:
        """Return a parameter, declared once for all its uses."""
        if label not in self.parameters:
            name, modelica_unit = self.name(label), unit_of_modelica(unit)
            modifier = f'(unit="{modelica_unit}")' if modelica_unit else ""
            comment = f" {quoted(description)}" if description else ""
            line = f"  parameter Real {name}{modifier} = {number(value).text}{comment};"
            self.parameters[label] = Text(name), line
        return self.parameters[label][0]

    def sampled(self, variable: Text, clock: str) -> Text:
        """Return the variable of a continuous value sampled by a clock."""
        key, value = (variable.text, self.clocks[clock]), f"sample({variable.text}, {self.clocks[clock]})"
        if key not in self.named:
            unquoted = variable.text.strip("'").replace("\\'", "'")
            self.named[key] = self.let(f"{unquoted} at {clock}", value, variable.unit)
        return self.named[key]

    def delayed(self, value: Text, label: str, clock: str, delay: Fraction) -> Text:
        """Return the variable of a delayed clocked value: whole ticks by previous, the rest by
        shiftSample.
        """
        ticks, fraction = divmod(delay / self.grids[clock][0], 1)
        for count in range(int(ticks)):
            delayed_name = f"{label} {count + 1} tick{'s' if count else ''} ago"
            value = self.like(value, delayed_name, f"previous({value.text})")
        if fraction:
            self._check(fraction.numerator, fraction.denominator)
            shifted = f"shiftSample({value.text}, {fraction.numerator}, {fraction.denominator})"
            value = self.like(value, f"{label} late", shifted)
        return value

    def received(self, sender: int, link: str, channel: int, timing: str, clock: str) -> Text:
        """Return the variable of a delayed sent value, sampled by another clock."""
        key = (sender, link, channel, timing, self.clocks[clock])
        if key not in self.named:
            self.named[key] = self._crossing(sender, link, channel, self.numbers.timings[timing], clock)
        return self.named[key]

    def _crossing(self, sender: int, link: str, channel: int, delay: Fraction, clock: str) -> Text:
        """Return the variable of a sent value after a delay, converted from the clock of its link to
        another clock.
        """
        sends_at = self.clock_of[link]
        value, name = self.sent[sender, link][channel]
        label = f"{self.comm_graph.peer_name(sender)}.{name}"
        delayed_label = f"{label} after {float(delay) * 1e3:.6g} ms"
        (slow, first), (fast, second) = self.grids[sends_at], self.grids[clock]
        if first == second and delay % slow == 0:
            value, ratio = self.delayed(value, f"{label} sent", sends_at, delay), slow / fast
            for operator, factor in (("superSample", ratio.numerator), ("subSample", ratio.denominator)):
                if factor > 1:
                    self._check(factor)
                    last = operator == "subSample" or ratio.denominator == 1
                    name_at_clock = f"{delayed_label} {'at' if last else 'for'} {clock}"
                    value = self.like(value, name_at_clock, f"{operator}({value.text}, {factor})")
            return value
        if not delay and (second - first) % _grid([slow, fast]) == 0:
            message = f"{link} without delay to {clock}: their ticks coincide but start at different times"
            raise _refused(self.model, message, f"set a delay of {link}, or use clocks of equal phase")
        advanced_delay = delay - _grid([slow, fast, first, second, delay]) / 2 if delay else delay
        value = self.delayed(value, f"{label} sent for {clock}", sends_at, advanced_delay)
        held_value = self.like(value, f"{delayed_label} for {clock}", f"hold({value.text})")
        return self.like(
            held_value, f"{delayed_label} at {clock}", f"sample({held_value.text}, {self.clocks[clock]})"
        )

    def _check(self, *counters: int) -> None:
        """Raise ApcError E955 for a counter beyond the range of Modelica's Integer."""
        if max(counters) > LARGEST_COUNTER:
            message = f"a clock that counts to {max(counters):,}, more than the range of a Modelica Integer"
            raise _refused(self.model, message, "use times that are simple multiples of each other")

    def _clocks(self) -> tuple[dict[str, str], list[str]]:
        """Return the name of each clock, and the lines that declare the clocks, fastest first."""
        used_clocks = {part.clock for peer_type in self.model.peer_types for part in peer_type.clocks}
        used_clocks |= {
            self.clock_of[sending.link] for peer_type in self.model.peer_types for sending in peer_type.sends
        }
        clock_by_grid: dict[tuple[Fraction, Fraction], str] = {}
        names: dict[str, str] = {}
        lines: list[str] = []
        for clock, grid in sorted(self.grids.items(), key=lambda pair: pair[1][0]):
            if clock not in used_clocks:
                continue
            if grid not in clock_by_grid:
                clock_by_grid[grid] = self._clock(clock, grid, clock_by_grid, lines)
            names[clock] = clock_by_grid[grid]
        return names, lines

    def _clock(
        self, clock: str, grid: tuple[Fraction, Fraction], clock_by_grid: Mapping[Any, str], lines: list[str]
    ) -> str:
        """Add the declaration of a clock, and return its name.

        The clock is derived from a faster clock with the same phase if one is declared already.

        Parameters
        ----------
        clock, grid
            The name of the clock, and its period and phase in seconds.
        clock_by_grid
            The names of the clocks declared so far, by period and phase.
        lines
            The declarations, which are extended.
        """
        (period, phase), name = grid, self.name(clock)
        self._check(period.numerator, period.denominator, (phase / period).denominator)
        finer = next((item for item in clock_by_grid if item[1] == phase), None)
        value, derived = f"Clock({period.numerator}, {period.denominator})", ""
        if finer is not None:
            ratio, value = period / finer[0], clock_by_grid[finer]
            self._check(ratio.numerator, ratio.denominator)
            if ratio.denominator > 1:
                base = self.name(f"{clock} divided")
                lines.append(f"  Clock {base} = superSample({value}, {ratio.denominator});")
                value = base
            derived = f"subSample({value}, {ratio.numerator})"
        elif phase:
            phase_ratio, base = phase / period, self.name(f"{clock} from 0")
            lines.append(f"  Clock {base} = {value};")
            derived = f"shiftSample({base}, {phase_ratio.numerator}, {phase_ratio.denominator})"
        description = quoted(f"every {float(period) * 1e3:.6g} ms, from {float(phase) * 1e3:.6g} ms")
        lines.append(f"  Clock {name} = {derived or value} {description};")
        return name


class _Peer:
    """The variables of one peer: its parameters `p`, states `x` and hold outputs `u`."""

    def __init__(self, writer: _ModelicaWriter, number: int, group: int) -> None:
        self.writer, self.number, self.group = writer, number, writer.model.groups[group]
        model, numbers, comm_graph = writer.model, writer.numbers, writer.comm_graph
        self.peer_type, self.name = model.peer_types[self.group.peer_type], comm_graph.peer_name(number)
        self.role = comm_graph.delay_class(group)
        rows = numbers.parameters[group]
        self.vector = rows[numbers.rows[group][number - int(comm_graph.starts[group])]].tolist()
        described = {parameter.name: parameter for parameter in model.parameters}
        begins = {state.start for state in self.peer_type.states}
        self.p: list[Text] = []
        for index, (name, value) in enumerate(zip(self.peer_type.parameters, self.vector, strict=True)):
            declared, label = described.get(name), name
            if (rows[:, index] != value).any():
                label = f"{self.name}.{name}"
            elif declared is None or declared.value != value:
                label = f"{self.group.name}.{name}"
            label += " at the start" if name in begins else ""
            unit, description = (declared.unit, declared.description) if declared else ("1", "")
            self.p.append(writer.parameter(label, value, unit, description))
        self.location = {name: self.p[index] for index, name in enumerate(self.peer_type.parameters)}
        self.units = {clock.clock: clock.units for clock in self.peer_type.clocks}

    def declare(self) -> None:
        """Declare the states, and the outputs of holds."""
        declare, peer_type = self.writer.declare, self.peer_type
        self.x = [
            declare(f"{self.name}.{state.name}", state.unit, self.location[state.start], fixed=True)
            for state in peer_type.states
        ]
        self.u = [
            declare(f"{self.name}.{hold.name} acting", self.units[hold.clock][hold.output])
            for hold in peer_type.holds
        ]

    def keep(self, expression: Text) -> Text:
        """Declare a variable for a long expression, and return it."""
        label = f"{self.name}: part {len(self.writer.declared) + 1}"
        variable = self.writer.declare(label, truth=expression.truth)
        self.writer.define(variable.text, expression.text)
        return variable

    def _sampled(self, clock: str) -> list[list[Callable[[], Text]]]:
        """Return functions that declare states, hold outputs and time as sampled by a clock, when they are
        needed.
        """
        sampled = self.writer.sampled
        return [
            [functools.partial(sampled, text, clock) for text in texts] for texts in (self.x, self.u, [TIME])
        ]

    def sends(self) -> None:
        """Add the equations of the sent values."""
        begin = start_sends(jacobians(self.peer_type), self.vector, float) if self.peer_type.sends else {}
        for sending in self.peer_type.sends:
            self.writer.comment(f"{self.name}: values sent over {sending.link}")
            x, u, t = self._sampled(self.writer.clock_of[sending.link])
            values = result_texts(sending.send, [x, u, self.p, t], self.keep)
            starts = [number(float(item)) for item in begin[sending.link]]
            names = [f"{self.name}.{channel} sent" for channel in sending.channels]
            texts = [value.text for value in values]
            variables = map(self.writer.let, names, texts, sending.units, starts)
            self.writer.sent[self.number, sending.link] = [*zip(variables, sending.channels, strict=True)]

    def tick(self, partition: ClockPartition) -> None:
        """Add the equations of a clock's ticks, and of its holds."""
        writer, name, outputs, units = self.writer, self.name, partition.outputs, partition.units
        starts = dict(zip(partition.memories, map(self.location.__getitem__, partition.starts), strict=True))
        writer.comment(f"{name}: outputs at ticks of {partition.clock}")
        x, u, t = self._sampled(partition.clock)
        y = [
            writer.declare(f"{name}.{output}", unit, starts.get(row, ZERO))
            for row, (output, unit) in enumerate(zip(outputs, units, strict=True))
        ]
        m = [
            writer.let(f"{name}.{outputs[row]} before", f"previous({y[row].text})", units[row])
            for row in partition.memories
        ]
        r = [self._received(receive, partition.clock, [x, u, m], t) for receive in partition.receives]
        values = result_texts(partition.tick, [x, u, m, r, self.p, t], self.keep)
        for variable, value in zip(y, values, strict=True):
            writer.define(variable.text, value.text)
        for acting, hold in zip(self.u, self.peer_type.holds, strict=True):
            if hold.clock == partition.clock:
                value, label = y[hold.output], f"{name}.{hold.name}"
                if hold.output in starts:  # values not yet computed are zero, for any start value
                    value = writer.let(f"{label} to act", value.text, value.unit, ZERO)
                delay = writer.numbers.timings[hold.delay]
                value = writer.delayed(value, label, partition.clock, delay)
                writer.define(acting.text, f"hold({value.text})")

    def _received(self, receive: Receive, clock: str, inside: Sequence[Any], t: Sequence[Any]) -> Text:
        """Return the variable of a receive: the reduction of all received values."""
        writer, link, comm_graph = self.writer, receive.link, self.writer.comm_graph
        terms, weights, unit = [], [], NONE
        for sender, inexact in received_by(writer.model, comm_graph, link, self.number):
            weight, role = exact_weight(inexact), comm_graph.delay_class(comm_graph.group_of(sender))
            timing = comm_graph.delay(link, role, self.role)
            received = [
                functools.partial(writer.received, sender, link, channel, timing, clock)
                for channel in range(len(writer.sent[sender, link]))
            ]
            if receive.edge is None:
                terms.append(received[receive.channel]())
                unit = terms[-1].unit
            else:
                terms.append(result_texts(receive.edge, [*inside, received, self.p, t], self.keep)[0])
            weights.append(weight)
        total = sum(weights, Fraction(0))
        if receive.operator in ("mean", "max", "min"):
            divided = total if receive.operator == "mean" else Fraction(1)
            check_mean(comm_graph, self.number, link, receive.operator, bool(terms), divided)
        if receive.operator in ("max", "min"):
            joined = "{}({}, {})".format
            value = functools.reduce(
                lambda a, b: joined(receive.operator, a, b), [term.text for term in terms]
            )
        else:
            value = " + ".join(
                term.within(SUM) if weight == 1 else f"{number(float(weight)).within(SUM + 1)}*({term.text})"
                for term, weight in zip(terms, weights, strict=True)
            )
            if receive.operator == "mean" and total != 1:
                value = f"({value})/{number(float(total)).within(SUM + 1)}"
        return writer.let(f"{self.name}.{receive.name}", value or "0", unit)


def _refuse_unsupported(model: Model, comm_graph: CommunicationGraph) -> None:
    """Raise ApcError E955 for constructs that Modelica equations cannot express."""
    for _, law in unreliable(model):
        message = f"{chance(law)}: random packet loss or delay"
        raise _refused(model, message, "use a reliable link, or apc simulate")
    for link in model.links:
        if link.after:
            message = f"packets of {link.name} that take the values after the ticks (order: after)"
            raise _refused(model, message, "use order: before, or apc simulate")
        if len(link.clocks) > 1:
            message = f"different clocks of the pairs of groups of {link.name}"
            raise _refused(
                model, message, "use one link for each clock, whose means are then separate, or apc simulate"
            )
    for peer_type in model.peer_types:
        for function, _, message, _ in [
            (peer_type.derivative, "", "what moves", ""),
            *instant_functions(peer_type),
        ]:
            if not function.is_a("SXFunction"):
                solved = (
                    f"the nonlinear loop of {peer_type.name} that Newton's method solves for {message[:120]}"
                )
                raise _refused(model, solved, "use a coupler without an algebraic loop")
    peers = comm_graph.peers
    terms = sum(
        peers * (peers - 1) if comm_graph.is_complete(link) else len(comm_graph.arcs(link)[0])
        for link in comm_graph.links
    )
    if max(terms, peers) > MOST_TERMS:
        message = f"{peers:,} peers with {terms:,} directed connections"
        raise _refused(
            model, message, f"reduce the number of peers, such as by --set {model.groups[0].name}.count=10"
        )


def _refused(model: Model, subject: str, advice: str) -> ApcError:
    """Return error E955 for a construct without a Modelica equivalent."""
    return ApcError(
        Diagnostic(
            "E955",
            SourceLocation(model.origin.topology),
            f"no Modelica equivalent of {subject}",
            advice=advice,
        )
    )


def _grid(times: Sequence[Fraction]) -> Fraction:
    """Return the largest time of which all given times are whole multiples."""
    whole = math.lcm(*(time.denominator for time in times))
    return Fraction(math.gcd(*(int(time * whole) for time in times)), whole)
