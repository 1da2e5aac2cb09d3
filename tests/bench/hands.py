"""What hands do and feel, averages against meshes: `python -m tests.bench.hands --out FILE`.

For two, three and five users of the paper's topology: the stiffness of the coordination that is borne with
free hands, with devices clamped and with every passive hand; the viscosity that the network adds to each
copy; how far copies are apart a newton of a slow push. The mesh is taken at equal stiffness (dashed) and, as
circles, at equal effective gain, where it must be the average.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import apc
from apc.output.pictures import COLOURS, write_figure
from apc.output.region_picture import PANEL
from apc.support.optional import need
from tests.bench.judge import Judge, decided, parser_of
from tests.topologies import AVERAGE, MESH, compiled, replaced

PEERS = (2, 3, 5)
STIFFNESS = 200.0  # of the coordination, in N/m: stable with every passive hand, mesh or average
HANDS = ("free", "clamped", "passive")
TOPOLOGIES = {"average": AVERAGE, "mesh": MESH}
# By an independent program (N/m): borne with free hands, clamped, and any passive ones; right to its digits.
KNOWN = {
    2: (1230.9581778682345, 276.5935041841296, 233.1356529292959),
    3: (1096.41, 539.93, 458.24),
    5: (1101.55, 1052.17, 895.64),
}
NEAR = 2e-5  # what two digits behind the point leave open
Curves = Mapping[
    tuple[str, str], list[float]
]  # by the scheme and what is said of it, a value for each of PEERS


def topology(text: str, peers: int, stiffness: float) -> apc.Model:
    """Return the paper's topology of so many users."""
    pairs = ("count: 3", f"count: {peers}"), ("stiffness: 500", f"stiffness: {stiffness}")
    return compiled(replaced(text, *pairs))


def required(judge: Judge, name: str, hands: str) -> list[float]:
    """Return the largest stable stiffness with such hands, by users, and judge it."""
    values = []
    for peers in PEERS:
        model = topology(TOPOLOGIES[name], peers, STIFFNESS)
        passive = hands == "passive"
        held = model if passive else apc.with_hands(model, hands)
        found = apc.critical(held, "coordination.stiffness", criterion="passive" if passive else None)
        assert found.value is not None
        values.append(found.value)
        known = KNOWN[peers][HANDS.index(hands)] / (1 if name == "average" else peers - 1)
        judge.within(f"{name} of {peers}, hands {hands}", abs(found.value / known - 1), NEAR)
    return values


def used(judge: Judge, name: str) -> tuple[list[float], list[float]]:
    """Return the network damping of each copy in N·s/m, and the coordination error in mm/N."""
    viscous, apart = [], []
    for peers in PEERS:
        found = apc.transparency(topology(TOPOLOGIES[name], peers, STIFFNESS), frequencies=[0.1])
        assert found.low_frequency is not None
        viscous.append(found.low_frequency.damping / peers - 5.0 - 5.0)  # of each device and copy
        apart.append(1e3 * abs(found.coordination_error[0]))
        gain = STIFFNESS * (peers - 1 if name == "mesh" else 1)
        formula = gain * ((8e-3 - 1e-3) / 2 + 8e-3)
        what = f"{name} of {peers}: viscosity beside K((T_n − T_c)/2 + T_d) = {formula:.4f}"
        judge.within(what, abs(viscous[-1] / formula - 1), 5e-3)
    return viscous, apart


def picture(curves: Curves) -> Any:
    """Draw stiffness, viscosity and distance over the number of users."""
    figure = need("matplotlib.figure", "plot").Figure(figsize=(PANEL * 3, PANEL + 0.5), layout="constrained")
    first, *others = figure.subplots(1, 3)
    for hands, colour in zip(HANDS, COLOURS, strict=False):
        mesh = curves["mesh", hands]
        even = [value * (peers - 1) for peers, value in zip(PEERS, mesh, strict=True)]
        first.plot(PEERS, curves["average", hands], "-o", color=colour, ms=4, label=f"{hands} hands")
        first.plot(PEERS, mesh, "--s", color=colour, ms=4, mfc="none")
        first.plot(PEERS, even, "o", color=colour, ms=9, mfc="none")
    titles = {
        "viscous": f"(b) network damping at\neach copy, {STIFFNESS:.0f} N/m [N·s/m]",
        "apart": "(c) coordination error of a slow push,\nthe same [mm/N]",
    }
    first.set_title("(a) largest stable stiffness [N/m]", fontsize=9)
    for ax, (what, title) in zip(others, titles.items(), strict=True):
        ax.plot(PEERS, curves["average", what], "-o", color="#000000", ms=4)
        ax.plot(PEERS, curves["mesh", what], "--s", color="#000000", ms=4, mfc="none")
        ax.set_title(title, fontsize=9)
    for ax in (first, *others):
        ax.set(xticks=PEERS, xlabel="users")
        ax.set_ylim(bottom=0)
        ax.tick_params(direction="in", top=True, right=True)
    handles, labels = first.get_legend_handles_labels()
    looks = ("-o", 4, "average"), ("--s", 4, "mesh, equal stiffness"), ("o", 9, "mesh, equal effective gain")
    for style, size, label in looks:
        handles.append(first.plot([], [], style, color="0.35", ms=size, mfc="none")[0])
        labels.append(label)
    figure.legend(handles, labels, loc="outside lower center", frameon=False, fontsize=8.5, ncols=6)
    return figure


def main() -> None:
    """Print, judge and draw."""
    parser = parser_of("hands", __doc__)
    parser.add_argument("--out", type=Path, help="draw it into this file: .svg, .png or .pdf")
    with decided(parser) as (judge, given):
        curves: dict[tuple[str, str], list[float]] = {}
        for name in TOPOLOGIES:
            curves |= {(name, hands): required(judge, name, hands) for hands in HANDS}
            curves[name, "viscous"], curves[name, "apart"] = used(judge, name)
        print("largest stable stiffness with hands [N/m]; network damping [N*s/m], coordination error [mm/N]")
        for (name, what), values in curves.items():
            listed = "  ".join(f"{n} users {v:.4f}" for n, v in zip(PEERS, values, strict=True))
            print(f"  {name:<8} {what:<8} {listed}")
        if given.out is not None:
            write_figure(picture(curves), given.out)


if __name__ == "__main__":
    main()
