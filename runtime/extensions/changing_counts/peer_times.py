"""The instants at which peers join and leave a simulation.

Takes: texts of options; the joins and leaves of a model's experiment.
Gives: `with_peer_times`, `presence_of`, `counts_of`, `model_of_present`,
`model_at_end`, `packets_fault`.
Guarantees: all invalid instants are reported together (E914). Peers join and leave at the starts of frames.
Does not: simulate (see `changing_engine`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Group, Model, PeerTime, count_of, group_count
from apc.compiler.errors import ApcError, Mistakes, SourceLocation
from apc.compiler.language.units import quantity
from apc.compiler.peer_counts import least_peers
from apc.compiler.source.reading import fault
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import OVERRIDE, find
from apc.simulation.presence import Presence, always_present, first_peers, location_of
from apc.simulation.simulation import Simulation
from apc.timing.schedule import Schedule

Flags = NDArray[np.bool_]

# The distance from the start of a frame, relative to a frame, that is the rounding of a float in seconds.
ROUNDED = Fraction(1, 10**9)

NEVER = np.iinfo(np.int64).max  # the instant of a leave that does not happen

_PEER = re.compile(r"(?P<group>.+?)(\[(?P<number>\d{1,9})\])?", re.ASCII)


def with_peer_times(model: Model, joins: Sequence[str], leaves: Sequence[str]) -> Model:
    """Return a model whose experiment has these joins and leaves; those of the model if empty.

    Parameters
    ----------
    model
        The model.
    joins, leaves
        A peer and its instant each, such as "user[4]=2 s".

    Raises
    ------
    ApcError
        E914 a text of another form, and the errors of `units.quantity`.
    """
    mistakes, given = Mistakes(), dict[str, tuple[PeerTime, ...]]()
    for key, texts in (("joins", joins), ("leaves", leaves)):
        for text in texts:
            with mistakes:
                given[key] = (*given.get(key, ()), _peer_time(key, text))
    mistakes.raise_if_any()
    experiment = model.experiment
    return replace(
        model,
        experiment=replace(
            experiment,
            joins=given.get("joins", experiment.joins),
            leaves=given.get("leaves", experiment.leaves),
        ),
    )


def _peer_time(key: str, text: str) -> PeerTime:
    """Return the peer and the instant of a text such as "user[4]=2 s"."""
    peer, equals, time = text.rpartition("=")
    location = SourceLocation(f"--{key}")
    if not (equals and peer.strip() and time.strip()):
        raise fault("E914", location, key, "PEER=TIME", text[:80] or "nothing", f'--{key} "user[1]=2 s"')
    try:
        at = quantity(time.strip(), location, subject=peer.strip(), unit="s", before=f"{peer.strip()}=")
    except ApcError as error:
        raise ApcError(
            replace(mistake, fix=f'--{key} "{mistake.fix}"' if mistake.fix else "")
            for mistake in error.mistakes
        ) from None
    return PeerTime(peer.strip(), Fraction(at.value))


def presence_of(model: Model, schedule: Schedule, duration: Fraction) -> Presence:
    """Return the peers that are present at each instant of a simulation.

    Parameters
    ----------
    model
        The model, whose experiment has joins or leaves.
    schedule
        The schedule of a frame of the first group.
    duration
        The duration of the simulation in seconds.

    Raises
    ------
    ApcError
        E914 an invalid join or leave, or a model whose peers can't join and leave.
    """
    mistakes, frame_s = Mistakes(), schedule.frame_s
    joins = np.zeros(model.peers, np.int64)
    leaves = np.full(model.peers, NEVER)
    first = first_peers(model)
    for key, array in (("joins", joins), ("leaves", leaves)):
        given = set[int]()
        for item in getattr(model.experiment, key):
            with mistakes:
                group, number = _peer_of(model, key, item)
                peer, name = first[group.name] + number - 1, f"{group.name}[{number}]"
                if peer in given:
                    raise _fault(model, key, item, name, f"one instant in {key}", "two")
                given.add(peer)
                _check_time(model, key, item, duration, frame_s)
                array[peer] = round(item.at / schedule.quantum)
                if key == "leaves" and item.at <= (join := joins[peer] * schedule.quantum):
                    raise _fault(model, key, item, f"leave of {name}", f"after its join at {_s(join)}")
    presence = Presence(joins, leaves, first)
    _check_links(model, presence, mistakes)
    mistakes.raise_if_any()
    changes = presence.changes(int(duration / schedule.quantum))
    for instant, present in zip([0, *changes.tolist()], presence.at(np.append(0, changes)), strict=True):
        _check_counts(model, present, instant * schedule.quantum)
    return presence


def _check_links(model: Model, presence: Presence, mistakes: Mistakes) -> None:
    """Record each link that does not allow joins and leaves."""
    key = "joins" if model.experiment.joins else "leaves"
    location = location_of(model, key, getattr(model.experiment, key)[0])
    constant_hub = bool(presence.joins[0] == 0 and presence.leaves[0] == NEVER)
    for link in model.links:
        graphs = ["complete", *["star"] * constant_hub, *["ring"] * (link.channel is None)]
        permitted = [("graph", link.graph.shape, graphs)]
        for channel in link.channels:
            permitted += [("on_loss", channel.on_loss, ["hold"])]
            permitted += [("reorder", channel.reorder, ["newest"])]
        for word, value, allowed in permitted:
            if value not in allowed:
                subject, got = f"{word} of {link.name} with joins or leaves", value.replace("arcs", "a list")
                expected = " or ".join(allowed)
                if value == "star":
                    how = {"advice": "keep the first peer, the center of the star, present"}
                elif value == "arcs":
                    how = {"advice": f"joins and leaves need one of these graphs of {link.name}"}
                else:
                    how = {"fix": f"{word}: {allowed[0]}"}
                mistakes.add("E914", location, subject, expected=expected, got=got, **how)


def _peer_of(model: Model, key: str, item: PeerTime) -> tuple[Group, int]:
    """Return the group and the number, from 1, of a peer such as "user[2]"; "user" is the peer of a group of
    one.
    """
    parsed = _PEER.fullmatch(item.peer.strip())
    groups = {group.name: group for group in model.groups}
    group = groups.get(parsed["group"]) if parsed else None
    if parsed and group and group.count > 1 and not parsed["number"]:
        expected = f"one peer of the group, {group.name}[1] to {group.name}[{group.count}]"
        fix = _written(key, replace(item, peer=f"{group.name}[1]"), _s(item.at))
        raise _fault(model, key, item, key, expected, group.name, fix)
    if parsed and group and 1 <= (number := int(parsed["number"] or 1)) <= group.count:
        return group, number
    known = ", ".join(f"{group.name}[1] to {group.name}[{group.count}]" for group in model.groups[:4])
    fix, advice = "", ""
    if parsed and group and int(parsed["number"] or 1) > group.count:
        name, least = group_count(group.name), parsed["number"]
        fix, advice = ("", f"raise {name} to {least}") if item.line else (f"--set {name}={least}", "")
    raise _fault(model, key, item, key, f"a peer of the topology ({known})", item.peer[:40], fix, advice)


def _check_time(model: Model, key: str, item: PeerTime, duration: Fraction, frame_s: Fraction) -> None:
    """Raise E914 for an instant that is not within the simulation, or not the start of a frame."""
    subject = f"{key.removesuffix('s')} of {item.peer.strip()}"
    if not 0 < item.at < duration:
        raise _fault(model, key, item, subject, f"more than 0 s and less than the duration, {_s(duration)}")
    if abs(item.at - round(item.at / frame_s) * frame_s) > ROUNDED * frame_s:
        before = item.at // frame_s * frame_s
        near = [at for at in (before, before + frame_s) if 0 < at < duration]
        expected = f"the start of a frame of {1000 * float(frame_s):.9g} ms"
        nearest = min(near, key=lambda at: abs(at - item.at), default=None)
        listed = " or ".join(map(_s, near))
        fix = "" if nearest is None else _written(key, item, _s(nearest))
        raise _fault(model, key, item, subject, f"{expected}, {listed}" if near else expected, fix=fix)


def _check_counts(model: Model, present: Flags, at: Fraction) -> None:
    """Raise E914 if a group has no present peer from an instant on, or all groups too few."""
    counts = counts_of(model, present)
    for group, count in zip(model.groups, counts, strict=True):
        least = max(1, least_peers(model.peer_types) - sum(counts) + count)
        if count < least:
            subject = f"peers of {group.name} from {_s(at)} on"
            raise _fault(model, *_change_at(model, at), subject, f"at least {least}", str(count))


def _change_at(model: Model, at: Fraction) -> tuple[str, PeerTime]:
    """Return the key and the entry of the last join or leave at an instant, by default of the first one."""
    items = [(key, item) for key in ("joins", "leaves") for item in getattr(model.experiment, key)]
    return next((pair for pair in reversed(items) if pair[1].at == at), items[0])


def packets_fault(model: Model, at: Fraction) -> ApcError:
    """Return the error E914 of a change after which no packets have some delay or clock of the links."""
    subject, expected = f"packets from {_s(at)} on", "all delays and clocks of the links in use"
    advice = "keep at least two peers of each group"
    return _fault(model, *_change_at(model, at), subject, expected, "fewer", advice=advice)


def counts_of(model: Model, present: Flags) -> list[int]:
    """Return the number of present peers of each group."""
    starts = [*first_peers(model).values()]
    counts: list[int] = np.add.reduceat(present.astype(np.int64), starts).tolist()
    return counts


def model_of_present(model: Model, present: Flags) -> Model:
    """Return the model of the present peers (N,) only, numbered anew in each group, without joins and leaves.

    Raises ApcError for numbers of peers that the model can't have.
    """
    own = {count_of(link.name) for link in model.links}
    starts = first_peers(model)
    plain = replace(
        always_present(model),
        groups=tuple(
            replace(group, columns=tuple(column for column in group.columns if column.name in own))
            for group in model.groups
        ),
    )
    changed = apply(
        plain,
        [
            Override(find(model, group_count(group.name), OVERRIDE, counts=True), Fraction(count))
            for group, count in zip(model.groups, counts_of(model, present), strict=True)
            if count != group.count
        ],
    )
    return replace(
        changed,
        groups=tuple(
            replace(
                new,
                columns=new.columns
                + tuple(
                    replace(column, values=column.values[present[starts[old.name] :][: old.count]])
                    for column in old.columns
                    if column.name not in own
                ),
            )
            for old, new in zip(model.groups, changed.groups, strict=True)
        ),
    )


def model_at_end(simulation: Simulation) -> Model:
    """Return the model of the peers that are present at the end of a simulation with joins or leaves."""
    assert simulation.presence is not None
    end = np.array([int(simulation.settings.duration / simulation.quantum)])
    return model_of_present(simulation.topology, simulation.presence.at(end)[0])


def _fault(
    model: Model,
    key: str,
    item: PeerTime,
    subject: str,
    expected: str,
    got: str = "",
    fix: str = "",
    advice: str = "",
) -> ApcError:
    """Return the error E914 of a join or leave, at its location."""
    return fault("E914", location_of(model, key, item), subject, expected, got or _s(item.at), fix, advice)


def _written(key: str, item: PeerTime, at: str) -> str:
    """Return a join or leave with another instant as the user writes it."""
    return f'"{item.peer}": {at}' if item.line else f'--{key} "{item.peer}={at}"'


def _s(seconds: Fraction) -> str:
    """Return an instant as text."""
    return f"{float(seconds):.9g} s"
