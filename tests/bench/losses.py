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
from fractions import Fraction
from functools import partial
from pathlib import Path

from scipy.optimize import brentq

from apc.analysis.analysis import prepare
from apc.frame.names import find
from apc.frame.overrides import Override, apply
from apc.moments.network import Growth, growth
from apc.optional import need
from apc.present.pictures import COLOURS, LINES, write_figure
from apc.present.region_picture import PANEL
from tests.bench.judge import Judge, judged, parser_of
from tests.topologies import SCENES, compiled, replaced

PEERS = (2, 3, 5)
MOST = 0.6  # the largest share of packets lost
STEP = 1.1  # how far apart stiffnesses are tried until the verdict changes
NEAR = 1e-7  # how near it is then found, relatively
SAME = 1e-6  # how near the mesh must lie to the average
ESTIMATED = 5  # users from which bursts are followed with fewer moments than there are
TOP = 2600.0  # the highest stiffness that is drawn
START = 1000.0  # where a pair of stiffnesses around the answer is first looked for
# Shares of packets lost that are looked at, beside 0: one by one, in bursts, in bursts that are estimated.
POINTS, FEWER, FEWEST = 24, 12, 6
# A way to lose packets by its label: its words on the link, and how many in a row, None if each by itself.
LAWS: dict[str, tuple[str, int | None]] = {
    "lost one by one, held": ("loss: 10 %", None),
    "lost one by one, zero": ("loss: 10 %, on_loss: zero", None),
    "bursts of 10, held": ("loss: {p: 1 %, r: 10 %}", 10),
    "bursts of 50, held": ("loss: {p: 0.2 %, r: 2 %}", 50),
}


def growths(peers: int, law: str, coupler: str = "AveragePosition") -> Callable[[float, float], Growth]:
    """Return what tells the growth of second moments at a share of losses and an effective stiffness."""
    words, burst = LAWS[law]
    text = (SCENES / "lossy-average.yaml").read_text(encoding="utf-8")
    pairs = (("count: 3", f"count: {peers}"), ("loss: 10 %", words), ("AveragePosition", coupler))
    system = compiled(replaced(text, *pairs))
    prepared = prepare(system)
    each = peers - 1 if coupler == "FullMesh" else 1

    def at(share: float, stiffness: float) -> Growth:
        lost = {"lan.loss.p": share / (1 - share) / burst} if burst else {"lan.loss": share}
        values = {"coordination.stiffness": stiffness / each, **lost}
        overrides = [Override(find(system, name), Fraction(value)) for name, value in values.items()]
        return growth(apply(system, overrides), prepared)

    return at


def largest(at: Callable[[float], Growth], start: float) -> tuple[float, float]:
    """Return the stiffness at which second moments begin to grow, and what bounds leave open of it."""

    def height(stiffness: float) -> float:
        return math.log(at(stiffness).radius)

    low = high = start
    while height(low) > 0:
        low, high = low / STEP, low
    while height(high) <= 0:
        low, high = high, high * STEP
    stiffness = float(brentq(height, low, high, rtol=NEAR))
    there, beside = at(stiffness), at(stiffness * (1 - 1e-4))
    slope = (there.radius - beside.radius) / (stiffness * 1e-4)
    return stiffness, max(there.high - there.radius, there.radius - there.low) / slope


def curve(judge: Judge, peers: int, law: str, start: float, quick: bool) -> tuple[list[float], list[float]]:
    """Return shares of packets lost, and the largest stable stiffness at each, a mesh's as well."""
    burst = LAWS[law][1]
    points = 3 if quick else POINTS if burst is None else FEWER if peers < ESTIMATED else FEWEST
    at, mesh = growths(peers, law), growths(peers, law, "FullMesh")
    shares = [MOST * place / points for place in range(1, points + 1)]
    values, left = [], 0.0
    for share in shares:
        start, open_ = largest(partial(at, share), start)
        values.append(start)
        left = max(left, open_)
    for share, value in list(zip(shares, values, strict=True))[points // 4 :: -(-points // 3)]:
        borne, _ = largest(partial(mesh, share), value)
        judge.within(f"mesh of {peers}, {law}, {share:.0%} lost", abs(borne / value - 1), SAME)
    exact = peers < ESTIMATED or burst is None
    told = "exact" if exact else f"an estimate: another order of moments, {left:.2g} N/m"
    numbers = "  ".join(f"{100 * x:.3g} %: {y:.1f}" for x, y in zip(shares, values, strict=True))
    print(f"  {law:<22} {told}\n    {numbers}", flush=True)
    return shares, values


def main() -> None:
    """Print and draw the curves."""
    parser = parser_of("losses", __doc__)
    parser.add_argument("--out", type=Path, help="draw them into this file: .svg, .png or .pdf")
    size = (PANEL * 3 + 0.6, PANEL + 1.0)
    figure = need("matplotlib.figure", "plot").Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, len(PEERS), sharey=True)
    with judged(parser) as (judge, given):
        print("largest stable coordination.stiffness [N/m] in mean square, by the share of packets lost")
        for ax, peers in list(zip(axes, PEERS, strict=True))[: 1 if given.quick else None]:
            whole = largest(partial(growths(peers, next(iter(LAWS))), 0.0), START)[0]
            print(f"\n{peers} users, {whole:.2f} with no packet lost")
            for law, line, colour in zip(LAWS, LINES, COLOURS, strict=False):
                shares, values = curve(judge, peers, law, whole, given.quick)
                percent = [100 * share for share in (0.0, *shares)]
                ax.plot(percent, [whole, *values], color=colour, linestyle=line, label=law)
                asked = slice(1 + len(shares) // 4, None, -(-len(shares) // 3))
                circles = percent[asked], [whole, *values][asked]
                ax.plot(*circles, "o", mfc="none", color=colour, ms=5)
            note = "bursts: an estimate" if peers >= ESTIMATED else "bursts: exact"
            ax.set_title(f"{peers} users ({note})", fontsize=9)
            ax.set(xlabel="packets lost [%]", xlim=(0, 100 * MOST), ylim=(0, TOP))
            ax.tick_params(direction="in", top=True, right=True)
            ax.grid(visible=True, linewidth=0.4, alpha=0.5)
        axes[0].plot([], [], "o", mfc="none", color="0.35", ms=5, label="mesh, its stiffness × (N − 1)")
        axes[0].set_ylabel("largest stable\ncoordination.stiffness [N/m]")
        shown = axes[0].get_legend_handles_labels()
        figure.legend(*shown, loc="outside lower center", frameon=False, fontsize=8.5, ncols=3)
        if given.out is not None:
            write_figure(figure, given.out)


if __name__ == "__main__":
    main()
