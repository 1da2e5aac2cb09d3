"""What hands do and feel, averages against meshes: `python -m tests.bench.hands --out FILE`.

For two, three and five users of the paper's scene: the stiffness of the coordination that is borne with free
hands, with devices clamped and with every passive hand; the viscosity that the network adds to each copy; how
far copies are apart a newton of a slow push. The mesh is taken at equal stiffness (dashed) and, as circles,
at equal effective gain, where it must be the average. Then times: a passive verdict, a thousand frequencies,
three users and a million; a hundred frequencies of a thousand users who all differ, beside one system of ten.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from apc.analysis.analysis import prepare
from apc.api import critical, with_hands
from apc.benchmark.timing import median_time
from apc.compiler.compiled import CompiledSystem
from apc.hands.asked import Port
from apc.hands.feel import feel
from apc.hands.passivity import passive_hands
from apc.hands.populations import PopulationResponses
from apc.optional import need
from apc.present.pictures import COLOURS, write_figure
from apc.present.region_picture import PANEL
from apc.threads import single_threaded
from tests.bench.judge import Judge, parser_of
from tests.populations import different
from tests.topologies import AVERAGE, MESH, compiled, replaced

PEERS = (2, 3, 5)
STIFFNESS = 200.0  # of the coordination, in N/m: stable with every passive hand, mesh or average
HANDS = ("free", "clamped", "passive")

# By an independent program (N/m): borne with free hands, clamped, and any passive ones; right to its digits.
KNOWN = {
    2: (1230.9581778682345, 276.5935041841296, 233.1356529292959),
    3: (1096.41, 539.93, 458.24),
    5: (1101.55, 1052.17, 895.64),
}
NEAR = 2e-5  # what two digits behind the point leave open

# Seconds: a verdict, a response of so many frequencies; a million users may take so many times what three do.
VERDICT_S, RESPONSE_S, FREQUENCIES, MILLION = 0.020, 0.050, 1000, 1.5

# Users who all differ, few enough for one system, and many; frequencies, seconds; how far two ways are apart.
FEW, MANY, SOME, MANY_S, APART = 10, 1000, 100, 6.0, 1e-9


def scene(text: str, peers: int, stiffness: float) -> CompiledSystem:
    """Return the paper's scene of so many users."""
    return compiled(
        replaced(text, ("count: 3", f"count: {peers}"), ("stiffness: 500", f"stiffness: {stiffness}"))
    )


def borne(text: str, peers: int, hands: str) -> float:
    """Return the largest stable stiffness of the coordination with such hands, in N/m."""
    system = scene(text, peers, STIFFNESS)
    if hands == "passive":
        found = critical(system, "coordination.stiffness", criterion="passive")
    else:
        found = critical(with_hands(system, hands), "coordination.stiffness")
    assert found.value is not None
    return found.value


def viscosity(text: str, peers: int, stiffness: float) -> tuple[float, float]:
    """Return what the network adds to the damping of each copy in N·s/m, and copies apart in mm a newton."""
    found = feel(scene(text, peers, stiffness), [0.1])
    assert found.low_frequency is not None
    own = 5.0 + 5.0  # of each device and copy
    return found.low_frequency.damping / peers - own, 1e3 * abs(found.error_per_force[0])


def main() -> None:
    """Print, judge and draw."""
    parser = parser_of("hands", __doc__)
    parser.add_argument("--out", type=Path, help="draw it into this file: .svg, .png or .pdf")
    given = parser.parse_args()
    judge = Judge(given.strict)
    with single_threaded():
        bearing = {name: _bearing(text, judge if text is AVERAGE else None) for name, text in SCENES.items()}
        felt = {name: [viscosity(text, peers, STIFFNESS) for peers in PEERS] for name, text in SCENES.items()}
        _alike(judge, bearing, felt)
        _times(judge)
        _unlike(judge)
    if given.out is not None:
        write_figure(_picture(bearing, felt), given.out)
    judge.end()


SCENES = {"average": AVERAGE, "mesh": MESH}


def _bearing(text: str, judge: Judge | None) -> dict[str, list[float]]:
    """Return the stiffness borne with each kind of hands, by users; judge it against what is known."""
    found: dict[str, list[float]] = {hands: [borne(text, n, hands) for n in PEERS] for hands in HANDS}
    print("largest stable coordination.stiffness [N/m], " + ("average" if text is AVERAGE else "mesh"))
    for hands, values in found.items():
        print(f"  {hands:<8}", "  ".join(f"{n} users {v:.2f}" for n, v in zip(PEERS, values, strict=True)))
    if judge is not None:
        for number, hands in enumerate(HANDS):
            for place, peers in enumerate(PEERS):
                off = abs(found[hands][place] / KNOWN[peers][number] - 1)
                judge.within(f"{peers} users, hands {hands}: beside an independent program", off, NEAR)
    return found


def _alike(
    judge: Judge, bearing: dict[str, dict[str, list[float]]], felt: dict[str, list[tuple[float, float]]]
) -> None:
    """Judge that the mesh at equal effective gain is the average, and what the network adds a formula's."""
    for hands in HANDS:
        for place, peers in enumerate(PEERS):
            ratio = bearing["mesh"][hands][place] * (peers - 1) / bearing["average"][hands][place]
            judge.within(
                f"mesh of {peers}, hands {hands}: its gain beside the average's", abs(ratio - 1), 1e-6
            )
    print(f"\nfelt at {STIFFNESS:.0f} N/m: viscosity of the network a copy [N*s/m], copies apart [mm/N]")
    for name, values in felt.items():
        for peers, (viscous, apart) in zip(PEERS, values, strict=True):
            gain = STIFFNESS * (peers - 1 if name == "mesh" else 1)
            formula = gain * ((8e-3 - 1e-3) / 2 + 8e-3)
            print(f"  {name:<8} {peers} users  {viscous:.4f}  {apart:.4f}   formula {formula:.4f}")
            judge.within(
                f"{name}, {peers} users: viscosity beside K((T_n − T_c)/2 + T_d)",
                abs(viscous / formula - 1),
                5e-3,
            )


def _times(judge: Judge) -> None:
    """Judge how long a passive verdict and a response take, of three users and of a million."""
    frequencies = np.geomspace(0.1, 60, FREQUENCIES)
    taken: dict[tuple[str, int], float] = {}
    for peers in (3, 1_000_000):
        system = scene(AVERAGE, peers, 400.0)
        prepared = prepare(system)
        for what, work in (
            ("verdict", lambda s=system, p=prepared: passive_hands(s, p)),
            ("response", lambda s=system, p=prepared: feel(s, frequencies, quick=True, prepared=p)),
        ):
            work()
            taken[what, peers], _ = median_time(work, 9)
            print(f"{what} of {peers:,} users: {1e3 * taken[what, peers]:.1f} ms")
    _told(judge, "a verdict with passive hands, three users [s]", taken["verdict", 3], VERDICT_S)
    _told(judge, f"{FREQUENCIES} frequencies felt, three users [s]", taken["response", 3], RESPONSE_S)
    for what in ("verdict", "response"):
        ratio = taken[what, 1_000_000] / taken[what, 3]
        _told(judge, f"{what}: a million users beside three", ratio, MILLION)


def _unlike(judge: Judge) -> None:
    """Judge what is felt among users who all differ: peer by peer beside one system of all, and its time."""
    frequencies = np.geomspace(0.1, 60, SOME)
    few, many = different(FEW), different(MANY)
    prepared = prepare(few)
    one = feel(few, frequencies, quick=True, prepared=prepared)
    with np.errstate(all="ignore"):
        alone = PopulationResponses(few, prepared, Port(0, ""), Port(1, ""))
        own = alone.steady(2j * np.pi * frequencies, (0,))[0][0]
    judge.within(
        f"{FEW} users who differ: beside one system of all", abs(own * one.impedance - 1).max(), APART
    )
    prepared = prepare(many)
    taken, _ = median_time(lambda: feel(many, frequencies, quick=True, prepared=prepared), 3)
    _told(judge, f"{SOME} frequencies felt, {MANY:,} users who all differ [s]", taken, MANY_S)


def _told(judge: Judge, what: str, value: float, most: float) -> None:
    """Judge and print a time, or a ratio of times."""
    print(f"  {what}: {value:.3g}, at most {most:.3g}: {judge.in_time(what, value, most)}")


def _picture(bearing: dict[str, dict[str, list[float]]], felt: dict[str, list[tuple[float, float]]]) -> Any:
    """Draw all three over the number of users."""
    figure = need("matplotlib.figure", "plot").Figure(figsize=(PANEL * 3, PANEL + 0.5), layout="constrained")
    first, *others = figure.subplots(1, 3)
    for hands, colour in zip(HANDS, COLOURS, strict=False):
        first.plot(PEERS, bearing["average"][hands], "-o", color=colour, ms=4, label=f"{hands} hands")
        first.plot(PEERS, bearing["mesh"][hands], "--s", color=colour, ms=4, mfc="none")
        even = [value * (n - 1) for n, value in zip(PEERS, bearing["mesh"][hands], strict=True)]
        first.plot(PEERS, even, "o", color=colour, ms=9, mfc="none")
    first.set_title("(a) stiffness borne [N/m]", fontsize=9)
    titles = (
        f"(b) viscosity of the network, felt at\neach copy at {STIFFNESS:.0f} N/m [N·s/m]",
        "(c) copies apart for a slow push,\nthe same [mm/N]",
    )
    for number, (ax, title) in enumerate(zip(others, titles, strict=True)):
        for name, style in (("average", "-o"), ("mesh", "--s")):
            values = [one[number] for one in felt[name]]
            ax.plot(PEERS, values, style, color="#000000", ms=4, mfc=None if name == "average" else "none")
        ax.set_title(title, fontsize=9)
    for ax in (first, *others):
        ax.set_xticks(PEERS)
        ax.set_xlabel("users")
        ax.set_ylim(bottom=0)
        ax.tick_params(direction="in", top=True, right=True)
    handles, labels = first.get_legend_handles_labels()
    for style, size, label in (
        ("-o", 4, "average"),
        ("--s", 4, "mesh, equal stiffness"),
        ("o", 9, "mesh, equal effective gain"),
    ):
        handles.append(first.plot([], [], style, color="0.35", ms=size, mfc="none")[0])
        labels.append(label)
    figure.legend(handles, labels, loc="outside lower center", frameon=False, fontsize=8.5, ncols=6)
    return figure


if __name__ == "__main__":
    main()
