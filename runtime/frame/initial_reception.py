"""The values that peers receive at the start, and the gains of their edge functions.

Takes: an `Instance` of a model, and its peers in classes with equal start.
Gives: `StartClasses`, `Gains`.
Guarantees: exact rationals.
Does not: choose the classes, or linearize (see `peer_classes`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.weights import exact_weight
from apc.frame.communication_graph import check_mean
from apc.frame.exact_arithmetic import evaluate_exact
from apc.frame.jacobians import edge_name
from apc.frame.linearize import InitialReception, start_sends, start_values
from apc.frame.numeric_model import Instance, PeerIndices
from apc.frame.parameters import exact_numbers

# The gain of a receive for each sender's channel, by (edge, channel): one for all senders, or one per group.
Gains = Mapping[tuple[str, str], tuple[Fraction, ...]]


class StartClasses:
    """Classes of peers with equal start; each receives the start values of the others."""

    def __init__(self, instance: Instance, classes: Sequence[PeerIndices]) -> None:
        self.exchange = exchange = instance.exchange
        self.counts = list(map(len, classes))
        self.peers = [peers.first for peers in classes]
        self.groups = list(map(exchange.group_of, self.peers))
        self.vectors = list(map(instance.vector, self.peers))
        self.subsystems = [instance.subsystems[group] for group in self.groups]
        self.schedules = [instance.schedules[group] for group in self.groups]
        exact: dict[tuple[int, bytes], tuple[list[Fraction], dict[str, list[Fraction]]]] = {}
        self.parameters: list[list[Fraction]] = []
        self.sent: list[dict[str, list[Fraction]]] = []
        for subsystem, vector in zip(self.subsystems, self.vectors, strict=True):
            key = (id(subsystem), vector.tobytes())
            if key not in exact:
                parameters = exact_numbers(subsystem.peer_type, vector)
                exact[key] = parameters, start_sends(subsystem, parameters)
            self.parameters.append(exact[key][0])
            self.sent.append(exact[key][1])
        class_of = {peer: g for g, peer in enumerate(self.peers)}
        self.arcs: dict[str, dict[int, list[tuple[int, Fraction]]]] = {}
        for name in exchange.links:
            if not exchange.is_complete(name) and len(class_of) == exchange.peers:
                receives: dict[int, list[tuple[int, Fraction]]] = {}
                pairs, weights = exchange.arcs(name)
                for (sender, receiver), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
                    receives.setdefault(class_of[receiver], []).append(
                        (class_of[sender], exact_weight(weight))
                    )
                self.arcs[name] = receives
        self._edges: dict[tuple[Any, ...], list[Fraction]] = {}

    def _senders(self, link: str, g: int) -> list[tuple[int, Fraction, int]]:
        """Return the classes that a peer of class g receives from over a link: (class, weight, number)."""
        if link in self.arcs:
            return [(h, weight, 1) for h, weight in self.arcs[link].get(g, ()) if link in self.sent[h]]
        counts = [count - (1 if g == h else 0) for h, count in enumerate(self.counts)]
        return [(h, Fraction(n), n) for h, n in enumerate(counts) if n and link in self.sent[h]]

    def senders(self, link: str, g: int) -> int:
        """Return the number of peers that a peer of class g receives from over a link."""
        return sum(number for _, _, number in self._senders(link, g))

    def sent_to(self, link: str, g: int) -> list[list[Fraction]]:
        """Return the start values sent over a link by each distinct sender of class g."""
        return [self.sent[h][link] for h, _, _ in self._senders(link, g)]

    def listen(self, g: int) -> tuple[InitialReception, Gains]:
        """Return the values received by class g at the start, and the gains of its edge functions."""
        subsystem, schedule = self.subsystems[g], self.schedules[g]
        values: list[Fraction] = []
        local: list[tuple[Fraction, ...] | None] = []
        gains: dict[tuple[str, str], tuple[Fraction, ...]] = {}
        for p, partition in enumerate(subsystem.peer_type.clocks):
            for index, receive in enumerate(partition.receives):
                senders = self._senders(receive.link, g)
                coupling_terms = schedule.coupling_terms(p, index)
                name = edge_name(partition, receive)
                if not name:
                    received = [
                        (weight, self.sent[h][receive.link][receive.channel]) for h, weight, _ in senders
                    ]
                    norm = (
                        self._norm(receive.operator, g, receive.link, senders)
                        if coupling_terms
                        else Fraction(1)
                    )
                    values.append(sum((weight * value for weight, value in received), Fraction(0)) / norm)
                    local.append(None)
                elif not coupling_terms:  # no live value depends on it
                    values.append(Fraction(0))
                    local.append(None)
                else:
                    value, part, slopes = self._over_edges(g, p, index, senders)
                    values.append(value)
                    local.append(part)
                    channels = list(dict.fromkeys(channel for _, channel in coupling_terms))
                    rows = subsystem.pattern.ticks[p].channels[index]
                    for row, channel in zip(rows, channels, strict=True):
                        listed = tuple(
                            slopes[h][row] if h in slopes else Fraction(0) for h in range(len(self.counts))
                        )
                        distinct = {listed[h] for h, _, _ in senders}
                        gains[name, channel] = tuple(distinct) if len(distinct) == 1 else listed
        return InitialReception(tuple(values), tuple(local)), gains

    def _norm(
        self, operator: str, g: int, link: str, senders: Sequence[tuple[int, Fraction, int]]
    ) -> Fraction:
        """Return the divisor of a mean, 1 for other operators."""
        if operator != "mean":
            return Fraction(1)
        total = sum((weight for _, weight, _ in senders), Fraction(0))
        check_mean(self.exchange, self.peers[g], link, operator, bool(senders), total)
        return total

    def _over_edges(
        self, g: int, p: int, index: int, senders: Sequence[tuple[int, Fraction, int]]
    ) -> tuple[Fraction, tuple[Fraction, ...], dict[int, list[Fraction]]]:
        """Return a receive's value, its slopes over its own (x, u, m), and over each sender's channels."""
        subsystem = self.subsystems[g]
        receive, edge = subsystem.peer_type.clocks[p].receives[index], subsystem.edges[p, index]
        x, u, m = start_values(subsystem, self.parameters[g])
        inside = len(x) + len(u) + len(m[p])
        result = {}
        for h, _, _ in senders:
            sent = self.sent[h][receive.link][: edge.function.numel_in(3)]
            key = (id(edge), self.vectors[g].tobytes(), tuple(sent))
            if key not in self._edges:
                arguments = [x, u, m[p], sent, self.parameters[g], [Fraction(0)]]
                self._edges[key] = [Fraction(value) for value in evaluate_exact(edge.function, arguments)[0]]
            result[h] = self._edges[key]
        norm = self._norm(receive.operator, g, receive.link, senders)
        if receive.operator in ("sum", "mean"):
            used = [(h, weight / norm) for h, weight, _ in senders]
        else:
            used = [
                (self._extreme(g, receive.name, receive.operator, receive.link, senders, result), Fraction(1))
            ]
        value = sum((weight * result[h][0] for h, weight in used), Fraction(0))
        local = tuple(
            sum((weight * result[h][1 + i] for h, weight in used), Fraction(0)) for i in range(inside)
        )
        return value, local, {h: result[h][1 + inside :] for h, _ in used}

    def _extreme(
        self,
        g: int,
        name: str,
        operator: str,
        link: str,
        senders: Sequence[tuple[int, Fraction, int]],
        result: Mapping[int, Sequence[Fraction]],
    ) -> int:
        """Return the class of the one sender with the largest, or smallest, value."""
        check_mean(self.exchange, self.peers[g], link, operator, bool(senders), Fraction(1))
        best = (max if operator == "max" else min)(result[h][0] for h, _, _ in senders)
        winners = [(h, number) for h, _, number in senders if result[h][0] == best]
        if sum(number for _, number in winners) > 1:
            peer = self.exchange.peer_name(self.peers[g])
            message = f"{name} of {peer}: {operator} over equal peers has no linearization"
            hint = "start values that differ from peer to peer"
            raise ApcError(Diagnostic("E803", SourceLocation(self.exchange.topology), message, hint=hint))
        return winners[0][0]
