"""Copies in the paper's scene while hands push at random and packets get lost: none of `apc.moments`.

Takes: the numbers of each peer, how likely a packet is lost, what stands in for a missed one.
Gives: `User`, `Table`: second moments over every pattern of lost packets, and the same played by chance.
Guarantees: a tick of 1 ms after the other, packets sent and heard every 8 ms, a frame after they were sent.
Does not: use any symmetry.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TICKS, TICK = 8, 1e-3
# Of each peer: both motions, both forces that act, the position on its way to the others.
DEVICE, CUBE, CONTACT, COORDINATION, SENT, OWN = 0, 2, 4, 5, 6, 7


@dataclass(frozen=True, slots=True)
class User:
    """A peer: device 0.1 kg, 5 N·s/m; its copy of the cube has `copy` kg and 5 N·s/m."""

    copy: float
    stiffness: float
    device: float = 0.1
    contact: float = 1000.0

    @property
    def moved(self) -> Floats:
        """What a tick makes of both motions, of both forces that act and of a push (4, 7)."""
        rate = np.zeros((7, 7))
        rate[0, 1] = rate[2, 3] = 1
        rate[1, [1, 4, 6]] = -5 / self.device, -1 / self.device, 1 / self.device
        rate[3, [3, 4, 5]] = -5 / self.copy, 1 / self.copy, -1 / self.copy
        return np.asarray(scipy.linalg.expm(rate * TICK)[:4])


@dataclass(frozen=True, slots=True)
class Table:
    """Users who follow the mean of the others, and how packets get lost: bad, good and bad again.

    A way turns bad with `p` after a packet, good with `r`; while bad it loses all. `ways` (receiver, sender)
    are all there are, unless given.
    """

    users: tuple[User, ...]
    p: float
    r: float
    zero: bool = False
    ways: tuple[tuple[int, int], ...] = ()

    @property
    def channels(self) -> list[tuple[int, int]]:
        """The ways (receiver, sender)."""
        return list(self.ways or itertools.permutations(range(len(self.users)), 2))

    @property
    def states(self) -> int:
        """How many states there are: each peer's, then what each way holds."""
        return OWN * len(self.users) + len(self.channels)

    def frame(self, lost: Floats) -> tuple[Floats, Floats]:
        """Return what a frame does to the state (n, n) and what pushes do (n, N · 8); lost packets are 1."""
        count = len(self.users)
        whole = np.eye(self.states)
        for c, (_, j) in enumerate(self.channels):
            place = OWN * count + c
            whole[place] = lost[c] * whole[place] + (1 - lost[c]) * np.eye(self.states)[OWN * j + SENT]
        for i in range(count):
            whole[OWN * i + SENT] = np.eye(self.states)[OWN * i + CUBE]
        pushes = np.zeros((self.states, count * TICKS))
        for tick in range(TICKS):
            step = np.eye(self.states)
            force = np.zeros((self.states, count * TICKS))
            for i, user in enumerate(self.users):
                moved = user.moved
                own = OWN * i
                step[own : own + 4, own : own + 6] = moved[:, :6]
                force[own : own + 4, i * TICKS + tick] = moved[:, 6]
                step[own + CONTACT : own + SENT] = 0
                step[own + CONTACT, [own + DEVICE, own + CUBE]] = user.contact, -user.contact
                step[own + COORDINATION, own + CUBE] = user.stiffness
                for c, (receiver, _) in enumerate(self.channels):
                    if receiver != i:
                        continue
                    missed = lost[c] if self.zero else 0.0
                    share = user.stiffness / sum(other == i for other, _ in self.channels)
                    step[own + COORDINATION, own + CUBE] -= missed * share
                    step[own + COORDINATION, OWN * count + c] -= (1 - missed) * share
            whole, pushes = step @ whole, step @ pushes + force
        return whole, pushes

    def error(self, peer: int) -> Floats:
        """Return the error of a copy as a form in the state."""
        count = len(self.users)
        form = np.zeros(self.states)
        form[[OWN * i + CUBE for i in range(count)]] = -1 / (count - 1)
        form[OWN * peer + CUBE] = 1.0
        return form

    def rms(self) -> list[float]:
        """Return the root mean square error of each copy, of all patterns' moments solved as one system."""
        count = len(self.channels)
        patterns = np.array(list(itertools.product((0.0, 1.0), repeat=count)))
        bad = self.p / (self.p + self.r)
        chances = np.prod(np.where(patterns > 0, bad, 1 - bad), axis=1)
        change = np.ones((1, 1))
        for _ in range(count):
            change = np.kron(change, [[1 - self.p, self.p], [self.r, 1 - self.r]])
        # Less how far the first device is, all moves by itself: nothing holds the common translation.
        still = np.zeros(self.states)
        for i in range(len(self.users)):
            still[[OWN * i + DEVICE, OWN * i + CUBE, OWN * i + SENT]] = 1
        still[OWN * len(self.users) :] = 1
        apart = np.eye(self.states) - np.outer(still, np.eye(self.states)[DEVICE])
        frames = [self.frame(lost) for lost in patterns]
        moves = np.array([apart @ whole for whole, _ in frames])
        drawn = np.array([apart @ push @ push.T @ apart.T for _, push in frames])
        drawn = np.einsum("st,sij->tij", chances[:, None] * change, drawn)
        moments = drawn
        while True:  # twice as many frames would need matrices of all pairs: one after the other
            after = np.einsum("st,sij->tij", change, moves @ moments @ moves.transpose(0, 2, 1)) + drawn
            if np.abs(after - moments).max() < 1e-13 * np.abs(after).max():
                break
            moments = after
        total = after.sum(axis=0)
        return [float(np.sqrt(self.error(i) @ total @ self.error(i))) for i in range(len(self.users))]

    def played(self, frames: int, runs: int, seed: int) -> Floats:
        """Return the mean of the first copy's squared error over frames, run by run (runs,)."""
        random = np.random.default_rng(seed)
        count = len(self.channels)
        known = {}
        state, total = np.zeros((runs, self.states)), np.zeros(runs)
        lost = random.random((runs, count)) < self.p / (self.p + self.r)
        skipped = frames // 10
        for number in range(frames + skipped):
            drawn = random.standard_normal((runs, len(self.users) * TICKS))
            for key in np.unique(lost, axis=0):
                which = (lost == key).all(axis=1)
                if key.tobytes() not in known:
                    known[key.tobytes()] = self.frame(key.astype(float))
                whole, push = known[key.tobytes()]
                state[which] = state[which] @ whole.T + drawn[which] @ push.T
            luck = random.random((runs, count))
            lost = np.where(lost, luck >= self.r, luck < self.p)
            if number >= skipped:
                total += (state @ self.error(0)) ** 2
        return total / frames

    def played_late(self, jitter: float, frames: int, runs: int, seed: int) -> Floats:
        """Return what `played` does where no packet is lost, but each late or early by at most `jitter`.

        Of what was sent in this frame, the one before, and the one before that, which is there for sure, the
        newest is heard that has come.
        """
        random = np.random.default_rng(seed)
        count, receivers, senders = len(self.users), *np.array(self.channels).T
        moved = np.array([user.moved for user in self.users])
        contact = np.array([user.contact for user in self.users])
        share = np.array([user.stiffness for user in self.users]) / (count - 1)
        state = np.zeros((runs, count, 7))
        sent = np.zeros((3, runs, count))
        late = np.zeros((2, runs, len(receivers)))
        total, skipped = np.zeros(runs), frames // 10
        for frame in range(frames + skipped):
            sent = np.concatenate([state[None, :, :, CUBE], sent[:2]])
            drawn = TICKS * TICK + jitter * random.uniform(-1, 1, late[0].shape)
            late = np.concatenate([drawn[None], late[:1]])
            if frame >= skipped:
                total += (state[:, 0, CUBE] - np.delete(state[..., CUBE], 0, axis=1).mean(axis=1)) ** 2
            for tick in range(TICKS):
                come = late <= np.array([tick, TICKS + tick])[:, None, None] * TICK
                heard = np.where(
                    come[0], sent[0][:, senders], np.where(come[1], sent[1][:, senders], sent[2][:, senders])
                )
                forces = np.zeros((runs, count))
                for c, receiver in enumerate(receivers):
                    forces[:, receiver] += share[receiver] * (state[:, receiver, CUBE] - heard[:, c])
                pressed = contact * (state[..., DEVICE] - state[..., CUBE])
                state[..., 6] = random.standard_normal((runs, count))
                state[..., :4] = np.einsum("cij,rcj->rci", moved, state)
                state[..., CONTACT], state[..., COORDINATION] = pressed, forces
        return total / frames
