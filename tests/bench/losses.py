"""The largest stable stiffness over how much a network loses: `python -m tests.bench.losses --out FILE`.

For two, three and five users of the paper's scene: packets lost each by itself, what is missed held or the
receiver's own value in its place, and bursts of 10 and 50 packets. Stable is meant in mean square.
Coordination to the average is drawn as lines, the mesh as circles, its stiffness counted once for each other:
they are computed apart, and must lie on the lines. Bursts of five users are an estimate; it is printed how
much one order of moments changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

from scipy.optimize import brentq

from apc.analysis.analysis import prepare
from apc.compiler.errors import Place
from apc.frame.names import find
from apc.frame.overrides import Override
from apc.moments.network import Growth
from apc.optional import need
from apc.present.pictures import COLOURS, LINES, write_figure
from apc.present.region_picture import PANEL
from apc.threads import single_threaded
from apc.vary.growth import growth_at
from tests.bench.judge import Judge, parser_of
from tests.topologies import SCENES, compiled, replaced

PEERS = (2, 3, 5)
MOST = 0.6  # the largest share of packets lost
STEP = 1.1  # how far apart stiffnesses are tried until the verdict changes
NEAR = 1e-7  # how near it is then found, relatively
SAME = 1e-6  # how near the mesh must lie to the average
ESTIMATED = 5  # users from which bursts are followed with fewer moments than there are
TOP = 2600.0  # the highest stiffness that is drawn
PLACE = Place("losses")

# Where a pair of stiffnesses around the answer is first looked for.
START = 1000.0

# Shares of packets lost that are looked at, beside 0: one by one, in bursts, in bursts that are estimated.
POINTS, FEWER, FEWEST = 24, 12, 6


@dataclass(frozen=True)
class Law:
    """A way to lose packets: its words on the link, and how many in a row, None if each by itself."""

    label: str
    words: str
    burst: int | None

    def numbers(self, share: float) -> dict[str, float]:
        """Return the link's numbers with which such a share is lost."""
        if self.burst is None:
            return {"lan.loss": share}
        return {"lan.loss.p": share / (1 - share) / self.burst}


LAWS = (
    Law("lost one by one, held", "loss: 10 %", None),
    Law("lost one by one, zero", "loss: 10 %, on_loss: zero", None),
    Law("bursts of 10, held", "loss: {p: 1 %, r: 10 %}", 10),
    Law("bursts of 50, held", "loss: {p: 0.2 %, r: 2 %}", 50),
)


def scene(peers: int, law: Law, coupler: str) -> str:
    """Return the paper's scene with so many users over such a network."""
    text = (SCENES / "lossy-average.yaml").read_text(encoding="utf-8")
    return replaced(
        text, ("count: 3", f"count: {peers}"), ("loss: 10 %", law.words), ("AveragePosition", coupler)
    )


def growths(peers: int, law: Law, coupler: str = "AveragePosition") -> Callable[[float, float], Growth]:
    """Return what tells the growth of second moments at a share of losses and an effective stiffness."""
    system = compiled(scene(peers, law, coupler))
    prepared = prepare(system)
    each = peers - 1 if coupler == "FullMesh" else 1

    def at(share: float, stiffness: float) -> Growth:
        values = {"coordination.stiffness": stiffness / each, **law.numbers(share)}
        overrides = [Override(find(system, name), Fraction(value)) for name, value in values.items()]
        return growth_at(system, prepared, overrides, PLACE)

    return at


def largest(at: Callable[[float], Growth], start: float) -> tuple[float, float]:
    """Return the stiffness at which second moments begin to grow, and what bounds or orders leave open of it.

    Parameters
    ----------
    at
        The growth at a stiffness.
    start
        Near which the search begins.
    """

    def height(stiffness: float) -> float:
        return math.log(at(stiffness).radius)

    low = high = start
    while height(low) > 0:
        low, high = low / STEP, low
    while height(high) <= 0:
        low, high = high, high * STEP
    found = float(brentq(height, low, high, rtol=NEAR))
    here, beside = at(found), at(found * (1 - 1e-4))
    slope = (here.radius - beside.radius) / (found * 1e-4)
    return found, max(here.high - here.radius, here.radius - here.low) / slope


def curve(peers: int, law: Law, start: float) -> tuple[list[float], list[float], float]:
    """Return shares, the largest stable stiffness at each, and how much of one is left open at most."""
    at = growths(peers, law)
    points = POINTS if law.burst is None else FEWER if peers < ESTIMATED else FEWEST
    shares = [MOST * place / points for place in range(1, points + 1)]
    found, left = [], 0.0
    for share in shares:
        start, open_ = largest(lambda stiffness, share=share: at(share, stiffness), start)
        found.append(start)
        left = max(left, open_)
    return shares, found, left


def check(peers: int, law: Law, shares: list[float], found: list[float], judge: Judge) -> list[float]:
    """Return which of the shares the mesh was asked at, and judge that it allows as much in all."""
    at = growths(peers, law, "FullMesh")
    asked = range(len(shares) // 4, len(shares), -(-len(shares) // 3))
    for place in asked:
        value, _ = largest(lambda stiffness, place=place: at(shares[place], stiffness), found[place])
        what = f"mesh of {peers}, {law.label}, {shares[place]:.0%} lost"
        judge.within(what, abs(value / found[place] - 1), SAME)
    return [shares[place] for place in asked]


def main() -> None:
    """Print and draw the curves."""
    parser = parser_of("losses", __doc__)
    parser.add_argument("--out", type=Path, help="draw them into this file: .svg, .png or .pdf")
    given = parser.parse_args()
    judge = Judge(given.strict)
    figure = need("matplotlib.figure", "plot").Figure(
        figsize=(PANEL * 3 + 0.6, PANEL + 1.0), layout="constrained"
    )
    axes = figure.subplots(1, len(PEERS), sharey=True)
    print("largest stable coordination.stiffness [N/m] in mean square, by the share of packets lost")
    with single_threaded():
        for ax, peers in zip(axes, PEERS, strict=True):
            whole = largest(partial(growths(peers, LAWS[0]), 0.0), START)[0]
            print(f"\n{peers} users, {whole:.2f} with no packet lost")
            for law, line, colour in zip(LAWS, LINES, COLOURS, strict=False):
                shares, found, left = curve(peers, law, whole)
                exact = peers < ESTIMATED or law.burst is None
                mesh = check(peers, law, shares, found, judge)
                told = "exact" if exact else f"an estimate: another order of moments, {left:.2g} N/m"
                numbers = "  ".join(f"{100 * x:.3g} %: {y:.1f}" for x, y in zip(shares, found, strict=True))
                print(f"  {law.label:<22} {told}\n    {numbers}", flush=True)
                percent = [100 * share for share in (0.0, *shares)]
                ax.plot(percent, [whole, *found], color=colour, linestyle=line, label=law.label)
                own = [found[shares.index(share)] for share in mesh]
                ax.plot([100 * share for share in mesh], own, "o", mfc="none", color=colour, ms=5, label=None)
            _entitle(ax, peers)
    axes[0].set_ylabel("largest stable\ncoordination.stiffness [N/m]")
    handles, labels = axes[0].get_legend_handles_labels()
    handles.append(axes[0].plot([], [], "o", mfc="none", color="0.35", ms=5)[0])
    labels.append("mesh, its stiffness × (N − 1)")
    figure.legend(
        handles, labels, loc="outside lower center", frameon=False, fontsize=8.5, ncols=3, handlelength=3
    )
    if given.out is not None:
        write_figure(figure, given.out)
    judge.end()


def _entitle(ax: Any, peers: int) -> None:
    note = "bursts: an estimate" if peers >= ESTIMATED else "bursts: exact"
    ax.set_title(f"{peers} users ({note})", fontsize=9)
    ax.set_xlabel("packets lost [%]")
    ax.set_xlim(0, 100 * MOST)
    ax.set_ylim(0, TOP)
    ax.tick_params(direction="in", top=True, right=True)
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)


if __name__ == "__main__":
    main()
