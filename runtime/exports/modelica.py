"""A scene as one flat model of Modelica 3.3, its clocks as clocked partitions (chapter 16).

Takes: a `CompiledSystem`. Gives: `ModelicaModel`, `modelica`.
Guarantees: the equations are those that `apc simulate` plays, not their slopes; a packet is heard, and a
force acts, at the tick and the instant that the scene says; times are rationals. What Modelica has no words
for is refused by name.
Does not: write files, or run the model.

    sampled    sample(x, clock)                   the value just before the tick, as here
    acts       hold(shiftSample(previous(f), …))  whole ticks of a delay by previous, the rest by shiftSample
    heard      superSample(previous(sent), n)     where the clocks begin together and the delay is whole ticks
    heard      sample(hold(shiftSample(…)))       elsewhere: available half a step of the grid of all times
                                                  early, so that the tick at that very instant sees it, as
                                                  sample takes the value just before
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ClockPartition, CompiledSystem, Kind, Receive
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import write_text
from apc.compiler.weights import exact_weight
from apc.distribution import program_version
from apc.exports.expressions import (
    SUM,
    Text,
    identifier,
    number,
    unit_of_modelica,
    used_inputs,
    written,
)
from apc.exports.words import word
from apc.finite_equations import finite_equations
from apc.frame.ages import stamped
from apc.frame.exchange import Exchange, build_exchange, check_mean
from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.frame.start import start_sends
from apc.network.nominal import left_out
from apc.result import Result
from apc.simulation.trajectory import texts_of

# Terms of all that is heard, and variables, that a file is written for: a tool flattens each of them.
MOST_TERMS = 20_000

# Of a counter of a clock: Modelica's Integer has 32 bits in most tools.
LARGEST_COUNTER = 2**31 - 1

SECOND = Fraction(1)


@dataclass(frozen=True, slots=True, eq=False)
class ModelicaModel(Result):
    """A scene as text of Modelica: the model's `name`, its `text`, and what it has.

    `clocks` are the lines that declare them.
    """

    shown_by = "exports:modelica"

    topology: str
    name: str
    text: str
    peers: int
    variables: int
    clocks: tuple[str, ...]


def write_modelica(path: Path, found: ModelicaModel) -> None:
    """Write a model to a file. Raises ApcError (E601)."""
    write_text(path, found.text)


def modelica(system: CompiledSystem) -> ModelicaModel:
    """Write a scene as a Modelica model.

    Parameters
    ----------
    system
        The compiled scene.

    Raises
    ------
    ApcError
        E955 what the scene says and Modelica has no words for; E801, E802 a mean that can't be.
    """
    with finite_equations(system.name):
        return _Writer(stamped(system)).model()


class _Writer:
    """Writes a model: declarations and equations as they are needed."""

    def __init__(self, system: CompiledSystem) -> None:
        self.system = system
        self.numbers = resolve(system)
        self.exchange: Exchange = build_exchange(system, self.numbers.timings)
        self.taken: dict[str, None] = {}
        self.parameters: dict[str, tuple[Text, str]] = {}
        self.declared: list[str] = []
        self.equations: list[str] = []
        self.units = {one.name: one.unit for one in system.parameters}
        self.abouts = {one.name: one.about for one in system.parameters}
        _refuse_what_has_no_words(system, self.exchange)
        self.clocks, self.clock_lines = self._clocks()
        self.group_of = [g for g, group in enumerate(system.groups) for _ in range(group.count)]
        self.sent: dict[tuple[int, str], list[Text]] = {}
        self.starts: dict[tuple[int, str], list[Text]] = {}
        self.heard: dict[tuple[int, str, int, str, str], Text] = {}
        self.sampled: dict[tuple[int, str, str], Text] = {}
        self.senders: dict[str, dict[int, list[tuple[int, Fraction]]]] = {}

    def model(self) -> ModelicaModel:
        """Return the model."""
        system, name = self.system, word(self.system.name)
        peers = range(len(self.group_of))
        vectors = [self._parameters(peer) for peer in peers]
        moving = [self._moving(peer, vectors[peer]) for peer in peers]
        for peer in peers:
            self._continuous(peer, moving[peer], vectors[peer])
        for peer in peers:
            self._sends(peer, moving[peer], vectors[peer])
        for peer in peers:
            for partition in self._kind(peer).clocks:
                self._tick(peer, partition, moving[peer], vectors[peer])
        lines = [f"model {name} {_quoted(system.about or system.name)}"]
        lines += [f"  // {one}" for one in self._header()]
        lines += [
            "",
            *(line for _, line in self.parameters.values()),
            "",
            *self.clock_lines,
            "",
            *self.declared,
        ]
        duration = float(system.experiment.duration or SECOND)
        step = min((self._timing(clock.period) for clock in system.clocks), default=SECOND / 1000)
        lines += ["equation", *self.equations, "", f"  annotation(experiment(StopTime={duration!r}, "]
        lines[-1] += f"Interval={float(step)!r}), Documentation(info={_quoted(self._about())}));"
        text = "\n".join([*lines, f"end {name};"])
        return ModelicaModel(
            topology=system.name,
            name=name,
            text=text,
            peers=len(self.group_of),
            variables=len(self.declared),
            clocks=tuple(line.strip() for line in self.clock_lines),
        )

    def _header(self) -> list[str]:
        source = _line(self.system.origin.topology)
        return [
            f"Written by apc {program_version()} from {source}; its texts have the SHA-256",
            f"{texts_of(self.system)}.",
            "One equation a line, in SI; a variable is named as in apc simulate, PEER[number].PART.VARIABLE.",
            "sample(x, c) is x just before the tick of c, hold(f) acts from the tick on.",
        ]

    def _about(self) -> str:
        return f"The equations that apc compiled of {self.system.name}: all peers, every tick and packet."

    def _kind(self, peer: int) -> Kind:
        return self.system.kinds[self.system.groups[self.group_of[peer]].kind]

    def _timing(self, name: str) -> Fraction:
        return self.numbers.timings[name]

    def _name(self, wanted: str) -> str:
        """Return a name that nothing else has, of letters that Modelica takes in quotes."""
        wanted = name = "".join(one if one.isascii() and one.isprintable() else "_" for one in wanted)
        number_ = 1
        while name in self.taken:
            number_ += 1
            name = f"{wanted} ({number_})"
        self.taken[name] = None
        return name

    def _declare(
        self,
        name: str,
        unit: str,
        *,
        start: Text | None = None,
        fixed: bool = False,
        about: str = "",
        kind: str = "Real",
    ) -> Text:
        """Declare a variable and return it."""
        if len(self.declared) >= MOST_TERMS:
            raise _refused(self.system, f"more than {MOST_TERMS:,} variables", "fewer peers: --set …")
        own = identifier(self._name(name))
        said = []
        if kind == "Real" and (modelica_unit := unit_of_modelica(unit)):
            said.append(f'unit="{modelica_unit}"')
        if start is not None:
            said.append(f"start={start.text}")
        if fixed:
            said.append("fixed=true")
        modifiers = f"({', '.join(said)})" if said else ""
        comment = f" {_quoted(about)}" if about else ""
        self.declared.append(f"  {kind} {own}{modifiers}{comment};")
        return Text(own)

    def _define(self, variable: Text, value: str) -> None:
        self.equations.append(f"  {variable.text} = {value};")

    def _parameters(self, peer: int) -> list[Text]:
        """Return a peer's parameters by name, each declared once for all who share it."""
        g = self.group_of[peer]
        group, kind = self.system.groups[g], self._kind(peer)
        rows: NDArray[np.float64] = self.numbers.parameters[g]
        own = rows[self.numbers.rows[g][peer - int(self.exchange.starts[g])]]
        usual = {one.name: one.value for one in self.system.parameters}
        found = []
        for place, name in enumerate(kind.parameters):
            value = float(own[place])
            if (rows[:, place] != value).any():
                label = f"{self.exchange.peer_name(peer)}.{name}"
            else:
                label = name if usual.get(name) == value else f"{group.name}.{name}"
            label += " at the start" if any(state.start == name for state in kind.states) else ""
            if label not in self.parameters:
                named = Text(identifier(self._name(label)))
                unit = unit_of_modelica(self.units.get(name, "1"))
                said = f'(unit="{unit}")' if unit else ""
                about = f" {_quoted(self.abouts[name])}" if self.abouts.get(name) else ""
                line = f"  parameter Real {named.text}{said} = {number(value).text}{about};"
                self.parameters[label] = (named, line)
            found.append(self.parameters[label][0])
        return found

    def _moving(self, peer: int, p: Sequence[Text]) -> tuple[list[Text], list[Text]]:
        """Declare a peer's states, and what its holds put out."""
        kind, name = self._kind(peer), self.exchange.peer_name(peer)
        place = {one: k for k, one in enumerate(kind.parameters)}
        x = [
            self._declare(f"{name}.{state.name}", state.unit, start=p[place[state.start]], fixed=True)
            for state in kind.states
        ]
        clocks = {one.clock: one for one in kind.clocks}
        u = [
            self._declare(f"{name}.{hold.name} acting", clocks[hold.clock].units[hold.output])
            for hold in kind.holds
        ]
        return x, u

    def _continuous(self, peer: int, moving: tuple[list[Text], list[Text]], p: Sequence[Text]) -> None:
        """Write how a peer moves."""
        kind, (x, u) = self._kind(peer), moving
        self.equations += ["", f"  // {self.exchange.peer_name(peer)}: what moves"]
        rates = written(kind.derivative, [x, u, p, [Text("time")]], self._keeping(peer))
        for state, rate in zip(x, rates, strict=True):
            self._define(Text(f"der({state.text})"), rate.text)

    def _keeping(self, peer: int) -> Callable[[Text], Text]:
        """Return what gives a long expression a name of its own."""
        known: dict[str, Text] = {}

        def keep(long: Text) -> Text:
            if long.text not in known:
                kind = "Boolean" if long.truth else "Real"
                name = f"{self.exchange.peer_name(peer)}: part {len(self.declared) + 1}"
                known[long.text] = self._declare(name, "^(", kind=kind)
                self._define(known[long.text], long.text)
            one = known[long.text]
            return Text(one.text, truth=long.truth)

        return keep

    def _at(self, peer: int, variable: Text, unit: str, clock: str, start: Text | None = None) -> Text:
        """Return a continuous value as a clock samples it."""
        key = (peer, variable.text, self.clocks[clock])
        if key not in self.sampled:
            bare = variable.text.strip("'").replace("\\'", "'")
            name = f"{bare} at {clock}" if variable.text != "time" else f"time at {clock}"
            self.sampled[key] = self._declare(name, unit, start=start)
            self._define(self.sampled[key], f"sample({variable.text}, {self.clocks[clock]})")
        return self.sampled[key]

    def _inside(
        self, peer: int, functions: Sequence[Any], clock: str, moving: tuple[list[Text], list[Text]]
    ) -> tuple[list[Text], list[Text], list[Text]]:
        """Return states, holds and time as a clock samples them, those that functions depend on."""
        kind, (x, u) = self._kind(peer), moving
        clocks = {one.clock: one for one in kind.clocks}
        used = [used_inputs(function) for function in functions]

        def needed(column: int, row: int) -> bool:
            return any(one[column][row] for one in used)

        states = [
            self._at(peer, one, state.unit, clock) if needed(0, row) else one
            for row, (one, state) in enumerate(zip(x, kind.states, strict=True))
        ]
        holds = [
            self._at(peer, one, clocks[hold.clock].units[hold.output], clock) if needed(1, row) else one
            for row, (one, hold) in enumerate(zip(u, kind.holds, strict=True))
        ]
        timed = any(one[-1] and one[-1][0] for one in used)
        now = self._at(-1, Text("time"), "s", clock) if timed else Text("time")
        return states, holds, [now]

    def _sends(self, peer: int, moving: tuple[list[Text], list[Text]], p: Sequence[Text]) -> None:
        """Write what a peer sends."""
        kind, name, g = self._kind(peer), self.exchange.peer_name(peer), self.group_of[peer]
        vector = self.numbers.parameters[g][
            self.numbers.rows[g][peer - int(self.exchange.starts[g])]
        ].tolist()
        begin = start_sends(jacobians(kind), vector, float) if kind.sends else {}
        for sending in kind.sends:
            clock = next(link.clock for link in self.system.links if link.name == sending.link)
            self.equations += ["", f"  // {name}: what it sends over {sending.link}"]
            x, u, t = self._inside(peer, [sending.send], clock, moving)
            values = written(sending.send, [x, u, p, t], self._keeping(peer))
            starts = [number(float(one)) for one in begin[sending.link]]
            self.starts[peer, sending.link] = starts
            self.sent[peer, sending.link] = [
                self._declare(f"{name}.{channel} sent", unit, start=start)
                for channel, unit, start in zip(sending.channels, sending.units, starts, strict=True)
            ]
            for variable, value in zip(self.sent[peer, sending.link], values, strict=True):
                self._define(variable, value.text)

    def _tick(
        self, peer: int, partition: ClockPartition, moving: tuple[list[Text], list[Text]], p: Sequence[Text]
    ) -> None:
        """Write what a peer computes at a clock's ticks, and how it acts."""
        kind, name = self._kind(peer), self.exchange.peer_name(peer)
        place = {one: k for k, one in enumerate(kind.parameters)}
        starts = {
            output: p[place[start]]
            for output, start in zip(partition.memories, partition.starts, strict=True)
        }
        self.equations += ["", f"  // {name}: what it computes at {partition.clock}"]
        edges = [one.edge for one in partition.receives if one.edge is not None]
        x, u, t = self._inside(peer, [partition.tick, *edges], partition.clock, moving)
        y = [
            self._declare(f"{name}.{output}", unit, start=starts.get(row, number(0.0)))
            for row, (output, unit) in enumerate(zip(partition.outputs, partition.units, strict=True))
        ]
        m = []
        for row in partition.memories:
            before = self._declare(f"{name}.{partition.outputs[row]} before", partition.units[row])
            self._define(before, f"previous({y[row].text})")
            m.append(before)
        r = [self._received(peer, one, partition.clock, [x, u, m], p, t) for one in partition.receives]
        values = written(partition.tick, [x, u, m, r, p, t], self._keeping(peer))
        for variable, value in zip(y, values, strict=True):
            self._define(variable, value.text)
        for acting, hold in zip(moving[1], kind.holds, strict=True):
            if hold.clock == partition.clock:
                plain = y[hold.output]
                delay, unit = self._timing(hold.delay), partition.units[hold.output]
                label = f"{name}.{hold.name}"
                if hold.output in starts:  # what was never computed acts as zero, whatever it starts from
                    plain = self._declare(f"{label} to act", unit, start=number(0.0))
                    self._define(plain, y[hold.output].text)
                late = self._late(plain, label, unit, partition.clock, delay, number(0.0))
                self._define(acting, f"hold({late.text})")

    def _late(self, value: Text, label: str, unit: str, clock: str, delay: Fraction, start: Text) -> Text:
        """Return a clocked value so much later: whole ticks by previous, what is left by shiftSample."""
        period = self._period(clock)
        ticks, rest = divmod(delay, period)
        for count in range(int(ticks)):
            ago = f"{count + 1} tick{'s' if count else ''} ago"
            before = self._declare(f"{label} {ago}", unit, start=start)
            self._define(before, f"previous({value.text})")
            value = before
        if rest:
            part = rest / period
            self._check(part.numerator, part.denominator)
            shifted = self._declare(f"{label} late", unit, start=start)
            self._define(shifted, f"shiftSample({value.text}, {part.numerator}, {part.denominator})")
            value = shifted
        return value

    def _received(
        self,
        peer: int,
        receive: Receive,
        clock: str,
        inside: Sequence[Sequence[Text]],
        p: Sequence[Text],
        t: Sequence[Text],
    ) -> Text:
        """Write what a peer makes of what it hears."""
        name, link = self.exchange.peer_name(peer), receive.link
        terms, weights = [], []
        for sender, weight in self._heard_of(peer, link):
            row = slice(None) if receive.edge is not None else slice(receive.channel, receive.channel + 1)
            channels = range(len(self.sent[sender, link]))[row]
            used = used_inputs(receive.edge)[3] if receive.edge is not None else [True] * len(channels)
            told = [
                self._heard(sender, peer, link, channel, clock) if needed else Text("0")
                for channel, needed in zip(channels, used, strict=True)
            ]
            if receive.edge is None:
                terms.append(told[0])
            else:
                terms.append(written(receive.edge, [*inside, told, p, t], self._keeping(peer))[0])
            weights.append(weight)
        total = sum(weights, Fraction(0))
        if receive.operator in ("mean", "max", "min"):
            plain = receive.operator == "mean"
            divided = total if plain else Fraction(1)
            check_mean(self.exchange, peer, link, receive.operator, bool(terms), divided)
        unit = self._unit_of(link, receive)
        found = self._declare(f"{name}.{receive.name}", unit)
        if receive.operator in ("max", "min"):
            value = terms[0].text
            for one in terms[1:]:
                value = f"{receive.operator}({value}, {one.text})"
        else:
            added = [
                one.within(SUM) if weight == 1 else f"{number(float(weight)).within(SUM + 1)}*({one.text})"
                for one, weight in zip(terms, weights, strict=True)
            ]
            value = " + ".join(added) or "0"
            if receive.operator == "mean" and total != 1:
                value = f"({value})/{number(float(total)).within(SUM + 1)}"
        self._define(found, value)
        return found

    def _unit_of(self, link: str, receive: Receive) -> str:
        if receive.edge is not None:
            return "^("
        for kind in self.system.kinds:
            for sending in kind.sends:
                if sending.link == link:
                    return sending.units[receive.channel]
        return "^("

    def _heard_of(self, peer: int, link: str) -> list[tuple[int, Fraction]]:
        """Return whom a peer hears over a link, and with what weights."""
        if link not in self.senders:
            found: dict[int, list[tuple[int, Fraction]]] = {}
            pairs, weights = self.exchange.arcs(link)
            for (sender, receiver), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
                if (sender, link) in self.sent:
                    found.setdefault(receiver, []).append((sender, exact_weight(weight)))
            self.senders[link] = {receiver: sorted(one) for receiver, one in found.items()}
        return self.senders[link].get(peer, [])

    def _heard(self, sender: int, receiver: int, link: str, channel: int, clock: str) -> Text:
        """Return what a peer sent as a clock of another sees it."""
        timing = self.exchange.delay(link, self._role(sender), self._role(receiver))
        key = (sender, link, channel, timing, self.clocks[clock])
        if key not in self.heard:
            self.heard[key] = self._crossing(sender, link, channel, self._timing(timing), clock)
        return self.heard[key]

    def _role(self, peer: int) -> int:
        return self.exchange.role(self.group_of[peer])

    def _crossing(self, sender: int, link: str, channel: int, delay: Fraction, clock: str) -> Text:
        """Write how a value goes from the clock of its link to that of a force."""
        sends_at = next(one.clock for one in self.system.links if one.name == link)
        own, start = self.sent[sender, link][channel], self.starts[sender, link][channel]
        sending = next(one for one in self._kind(sender).sends if one.link == link)
        label = f"{self.exchange.peer_name(sender)}.{sending.channels[channel]}"
        unit, ms = sending.units[channel], f"{float(delay) * 1e3:.6g} ms"
        slow, fast = self._period(sends_at), self._period(clock)
        first, second = self._phase(sends_at), self._phase(clock)
        if first == second and delay % slow == 0:
            late = self._late(own, f"{label} sent", unit, sends_at, delay, start)
            ratio = slow / fast
            for made, factor in (("superSample", ratio.numerator), ("subSample", ratio.denominator)):
                if factor > 1:
                    self._check(factor)
                    last = made == "subSample" or ratio.denominator == 1
                    at = f"{label} after {ms} at {clock}" if last else f"{label} after {ms} for {clock}"
                    heard = self._declare(at, unit, start=start)
                    self._define(heard, f"{made}({late.text}, {factor})")
                    late = heard
            return late
        if not delay and (second - first) % _grid([slow, fast]) == 0:
            what = f"{link} without delay to {clock}: their ticks meet, and begin at different times"
            raise _refused(self.system, what, f'--set {link}.delay="…", or clocks of one phase')
        grid = _grid([slow, fast, first, second, delay])
        early = delay - grid / 2 if delay else delay
        late = self._late(own, f"{label} sent for {clock}", unit, sends_at, early, start)
        there = self._declare(f"{label} after {ms} for {clock}", unit, start=start)
        self._define(there, f"hold({late.text})")
        heard = self._declare(f"{label} after {ms} at {clock}", unit, start=start)
        self._define(heard, f"sample({there.text}, {self.clocks[clock]})")
        return heard

    def _clock(self, name: str) -> Any:
        return next(one for one in self.system.clocks if one.name == name)

    def _period(self, clock: str) -> Fraction:
        return self._timing(self._clock(clock).period)

    def _phase(self, clock: str) -> Fraction:
        return self._timing(self._clock(clock).phase)

    def _check(self, *counters: int) -> None:
        if max(counters) > LARGEST_COUNTER:
            what = f"a clock that counts to {max(counters):,}, more than an Integer of Modelica holds,"
            raise _refused(self.system, what, "times that are simple multiples of one another")

    def _clocks(self) -> tuple[dict[str, str], list[str]]:
        """Return what each clock is called, and the lines that declare them, the fastest first."""
        used = {part.clock for kind in self.system.kinds for part in kind.clocks}
        used |= {
            link.clock
            for link in self.system.links
            if any(one.link == link.name for kind in self.system.kinds for one in kind.sends)
        }
        names: dict[str, str] = {}
        lines: list[str] = []
        made: list[tuple[Fraction, Fraction, str]] = []
        clocks = [one for one in self.system.clocks if one.name in used]
        for clock in sorted(clocks, key=lambda one: self._timing(one.period)):
            period, phase = self._timing(clock.period), self._timing(clock.phase)
            same = next((one for one in made if one[:2] == (period, phase)), None)
            if same is not None:
                names[clock.name] = same[2]
                continue
            own = identifier(self._name(clock.name))
            told = _quoted(f"every {float(period) * 1e3:.6g} ms, from {float(phase) * 1e3:.6g} ms")
            finer = next((one for one in made if one[1] == phase), None)
            self._check(period.numerator, period.denominator, (phase / period).denominator)
            if finer is not None:
                ratio, base = period / finer[0], finer[2]
                self._check(ratio.numerator, ratio.denominator)
                if ratio.denominator > 1:
                    base = identifier(self._name(f"{clock.name} divided"))
                    lines.append(f"  Clock {base} = superSample({finer[2]}, {ratio.denominator});")
                lines.append(f"  Clock {own} = subSample({base}, {ratio.numerator}) {told};")
            elif phase:
                base = identifier(self._name(f"{clock.name} from 0"))
                part = phase / period
                lines.append(f"  Clock {base} = Clock({period.numerator}, {period.denominator});")
                lines.append(
                    f"  Clock {own} = shiftSample({base}, {part.numerator}, {part.denominator}) {told};"
                )
            else:
                lines.append(f"  Clock {own} = Clock({period.numerator}, {period.denominator}) {told};")
            made.append((period, phase, own))
            names[clock.name] = own
        return names, lines


def _refuse_what_has_no_words(system: CompiledSystem, exchange: Exchange) -> None:
    """Refuse what the equations of a model can't say: ApcError E955."""
    for note in left_out(system):
        what = f"{note.removeprefix('left out: ').partition(';')[0]}: luck that is drawn packet by packet"
        raise _refused(system, what, "a link without it, or apc simulate")
    for kind in system.kinds:
        edges = [one.edge for part in kind.clocks for one in part.receives if one.edge is not None]
        functions = [(kind.derivative, "what moves"), *((one, "a look at others") for one in edges)]
        functions += [(part.tick, ", ".join(part.outputs)) for part in kind.clocks]
        functions += [(one.send, ", ".join(one.channels)) for one in kind.sends]
        for function, what in functions:
            if not function.is_a("SXFunction"):
                told = f"the nonlinear loop of {kind.name} that Newton's method solves for {what[:120]}"
                raise _refused(system, told, "a coupler without a loop")
    terms = sum(
        exchange.peers * (exchange.peers - 1)
        if exchange.is_complete(link.name)
        else len(exchange.arcs(link.name)[0])
        for link in system.links
    )
    if max(terms, exchange.peers) > MOST_TERMS:
        what = f"{exchange.peers:,} peers, who hear {terms:,} times of one another, one by one"
        raise _refused(system, what, f"fewer peers: --set {system.groups[0].name}.count=10")


def _refused(system: CompiledSystem, what: str, hint: str) -> ApcError:
    return ApcError(Mistake("E955", Place(system.origin.topology), f"not in Modelica: {what}", hint=hint))


def _grid(times: Sequence[Fraction]) -> Fraction:
    """Return the largest time that all of some times are whole multiples of."""
    whole = math.lcm(*(time.denominator for time in times))
    return Fraction(math.gcd(*(int(time * whole) for time in times)), whole)


def _line(text: str) -> str:
    return "".join(one if one.isprintable() else " " for one in text)


def _quoted(text: str) -> str:
    """Return a text as Modelica writes it."""
    escaped = _line(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
