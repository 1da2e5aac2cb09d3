"""The values that peers receive at the start, and the gains of their edge functions.

Takes: the numbers of a model, and its peers in classes with equal start.
Gives: `StartClasses`, `Gains`.
Guarantees: exact rationals.
Does not: choose the classes, or linearize (see `peer_classes`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from apc.compiler.compiled import Receive
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.weights import exact_weight
from apc.lifting.model_numbers import ModelNumbers, PeerIndices
from apc.linearization.jacobians import edge_name
from apc.linearization.linearize import InitialReception, start_sends, start_values
from apc.parameter_values.exact_arithmetic import evaluate_exact
from apc.timing.communication_graph import check_mean

# The gain of a receive for each sender's channel, by (edge, channel): one for all senders, or one
# per sending class.
Gains = Mapping[tuple[str, str], tuple[Fraction, ...]]


class StartClasses:
    """Classes of peers with equal start; each receives the start values of the others.

    In the methods `g` is the index of the receiving class, `h` that of a sending class, and `p` that of a
    clock partition.
    """

    def __init__(self, numeric: ModelNumbers, classes: Sequence[PeerIndices]) -> None:
        self.comm_graph = comm_graph = numeric.comm_graph
        self.counts = list(map(len, classes))
        self.peers = [peers.first for peers in classes]
        self.groups = list(map(comm_graph.group_of, self.peers))
        self.vectors = list(map(numeric.vector, self.peers))
        self.peer_types = [numeric.model.groups[group].peer_type for group in self.groups]
        self.subsystems = [numeric.subsystems[group] for group in self.groups]
        self.schedules = [numeric.schedules[group] for group in self.groups]
        exact: dict[tuple[int, bytes], tuple[list[Fraction], dict[str, list[Fraction]]]] = {}
        self.parameters: list[list[Fraction]] = []
        self.sent: list[dict[str, list[Fraction]]] = []
        for subsystem, peer_type, peer in zip(self.subsystems, self.peer_types, self.peers, strict=True):
            key = (peer_type, numeric.vector(peer).tobytes())
            if key not in exact:
                parameters = numeric.exact_vector(peer)
                exact[key] = parameters, start_sends(subsystem, parameters)
            self.parameters.append(exact[key][0])
            self.sent.append(exact[key][1])
        class_of = {peer: g for g, peer in enumerate(self.peers)}
        self.arcs: dict[str, dict[int, list[tuple[int, Fraction]]]] = {}
        for name in comm_graph.links:
            if not comm_graph.is_complete(name) and len(class_of) == comm_graph.peers:
                receives: dict[int, list[tuple[int, Fraction]]] = {}
                pairs, weights = comm_graph.arcs(name)
                for (sender, receiver), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
                    receives.setdefault(class_of[receiver], []).append(
                        (class_of[sender], exact_weight(weight))
                    )
                self.arcs[name] = receives
        self._edges: dict[tuple[Any, ...], list[Fraction]] = {}

    def _senders(self, link: str, g: int) -> list[tuple[int, Fraction, int]]:
        """Return the classes from which a peer of class g receives over a link: (class, weight, number)."""
        if link in self.arcs:
            return [(h, weight, 1) for h, weight in self.arcs[link].get(g, ()) if link in self.sent[h]]
        counts = [count - (1 if g == h else 0) for h, count in enumerate(self.counts)]
        return [(h, Fraction(n), n) for h, n in enumerate(counts) if n and link in self.sent[h]]

    def senders(self, link: str, g: int) -> int:
        """Return the number of peers from which a peer of class g receives over a link."""
        return sum(number for _, _, number in self._senders(link, g))

    def factors(self, receive: Receive, g: int) -> list[tuple[int, float]]:
        """Return the factor of each sending class in a receive of class g; 1 for a maximum or minimum."""
        senders = self._senders(receive.link, g)
        norm = self._divisor(receive.operator, g, receive.link, senders)
        linear = receive.operator in ("sum", "mean")
        return [(h, float(weight / norm) if linear else 1.0) for h, weight, _ in senders]

    def sent_to(self, link: str, g: int) -> list[list[Fraction]]:
        """Return the start values that class g receives over a link, a list for each class of senders."""
        return [self.sent[h][link] for h, _, _ in self._senders(link, g)]

    def reception(self, g: int) -> tuple[InitialReception, Gains]:
        """Return the values that class g receives at the start with their slopes, and the gains of its edge
        functions.
        """
        subsystem, schedule = self.subsystems[g], self.schedules[g]
        values: list[Fraction] = []
        own_slopes: list[tuple[Fraction, ...] | None] = []
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
                        self._divisor(receive.operator, g, receive.link, senders)
                        if coupling_terms
                        else Fraction(1)
                    )
                    values.append(sum((weight * value for weight, value in received), Fraction(0)) / norm)
                    own_slopes.append(None)
                elif not coupling_terms:  # no live value depends on it
                    values.append(Fraction(0))
                    own_slopes.append(None)
                else:
                    value, slopes_of_own, slopes = self._over_edges(g, p, index, senders)
                    values.append(value)
                    own_slopes.append(slopes_of_own)
                    channels = list(dict.fromkeys(channel for _, channel in coupling_terms))
                    rows = subsystem.pattern.ticks[p].channels[index]
                    for row, channel in zip(rows, channels, strict=True):
                        class_gains = tuple(
                            slopes[h][row] if h in slopes else Fraction(0) for h in range(len(self.counts))
                        )
                        distinct = {class_gains[h] for h, _, _ in senders}
                        gains[name, channel] = tuple(distinct) if len(distinct) == 1 else class_gains
        return InitialReception(tuple(values), tuple(own_slopes)), gains

    def _divisor(
        self, operator: str, g: int, link: str, senders: Sequence[tuple[int, Fraction, int]]
    ) -> Fraction:
        """Return the divisor of a reduction: the sum of the senders' weights for a mean, 1 for other
        operators.

        `senders` are the sending classes, with weight and number. Raises ApcError for a mean over no peers.
        """
        if operator != "mean":
            return Fraction(1)
        weight_sum = sum((weight for _, weight, _ in senders), Fraction(0))
        check_mean(self.comm_graph, self.peers[g], link, operator, bool(senders), weight_sum)
        return weight_sum

    def _over_edges(
        self, g: int, p: int, index: int, senders: Sequence[tuple[int, Fraction, int]]
    ) -> tuple[Fraction, tuple[Fraction, ...], dict[int, list[Fraction]]]:
        """Return a receive's value, its slopes over its own (x, u, m), and its slopes over the channels of
        each sender.

        Parameters
        ----------
        g, p, index
            The receiving class, its clock partition, and the receive.
        senders
            The sending classes, with weight and number.
        """
        subsystem = self.subsystems[g]
        receive, edge = subsystem.peer_type.clocks[p].receives[index], subsystem.edges[p, index]
        x, u, m = start_values(subsystem, self.parameters[g])
        own_count = len(x) + len(u) + len(m[p])
        result = {}
        for h, _, _ in senders:
            sent = self.sent[h][receive.link][: edge.function.numel_in(3)]
            key = (self.peer_types[g], p, index, self.vectors[g].tobytes(), tuple(sent))
            if key not in self._edges:
                arguments = [x, u, m[p], sent, self.parameters[g], [Fraction(0)]]
                self._edges[key] = [Fraction(value) for value in evaluate_exact(edge.function, arguments)[0]]
            result[h] = self._edges[key]
        norm = self._divisor(receive.operator, g, receive.link, senders)
        if receive.operator in ("sum", "mean"):
            weights = [(h, weight / norm) for h, weight, _ in senders]
        else:
            weights = [
                (
                    self._extreme_sender(g, receive.name, receive.operator, receive.link, senders, result),
                    Fraction(1),
                )
            ]
        value = sum((weight * result[h][0] for h, weight in weights), Fraction(0))
        own_slopes = tuple(
            sum((weight * result[h][1 + i] for h, weight in weights), Fraction(0)) for i in range(own_count)
        )
        return value, own_slopes, {h: result[h][1 + own_count :] for h, _ in weights}

    def _extreme_sender(
        self,
        g: int,
        name: str,
        operator: str,
        link: str,
        senders: Sequence[tuple[int, Fraction, int]],
        values: Mapping[int, Sequence[Fraction]],
    ) -> int:
        """Return the class of the sender with the largest, or smallest, value.

        Parameters
        ----------
        g, name
            The receiving class, and the name of the receive for messages.
        operator, link
            "max" or "min", and the link.
        senders
            The sending classes, with weight and number.
        values
            The value of the edge function and its slopes by sending class, value first.

        Raises
        ------
        ApcError
            E803 several senders have this value.
        """
        check_mean(self.comm_graph, self.peers[g], link, operator, bool(senders), Fraction(1))
        best = (max if operator == "max" else min)(values[h][0] for h, _, _ in senders)
        winners = [(h, number) for h, _, number in senders if values[h][0] == best]
        if sum(number for _, number in winners) > 1:
            peer = self.comm_graph.peer_name(self.peers[g])
            message = f"{name} of {peer}: {operator} over peers with equal values has no linearization"
            advice = "use initial values that differ between peers"
            raise ApcError(
                Diagnostic("E803", SourceLocation(self.comm_graph.topology), message, advice=advice)
            )
        return winners[0][0]
