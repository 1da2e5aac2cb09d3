"""A peer in C: what it computes is what `simulate` computes, and nothing else is in it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.exports.peer_step import peer_of
from apc.simulation.settings import DEFAULT, parse_method
from apc.simulation.simulation import plan_of
from tests.hand_over.in_c import SANITIZED, STRICT, build, compiler, differences, worst
from tests.topologies import AVERAGE, ROOT, TOPOLOGIES, compiled, replaced

MOVED = replaced(AVERAGE, ("user: {count: 3}", "user: {count: 3, set: {device.x: [30 mm, -20 mm, 7 mm]}}"))
RING = replaced(MOVED, ("delay: 8 ms}", "delay: 8 ms, graph: ring}"))
PAPER = (TOPOLOGIES / "experiment-average.yaml").read_text(encoding="utf-8").partition("\n")[2]
MIXED = replaced(
    (TOPOLOGIES / "mixed-clocks.yaml").read_text(encoding="utf-8").partition("\n")[2],
    ("near: {count: 2}", "near: {count: 2, set: {device.x: [30 mm, -20 mm]}}"),
)
INSIDE = replaced(MOVED, ("delay: 1 ms, link: lan", "delay: 2.3 ms, link: lan"))
LOSSY = replaced(MOVED, ("delay: 8 ms}", "delay: 8 ms, loss: 20 %, jitter: 3 ms, on_loss: zero}"))
LOSSY_HOLD = replaced(MOVED, ("delay: 8 ms}", "delay: 8 ms, loss: 20 %, jitter: 3 ms, reorder: all}"))
PAIRS = replaced(
    MOVED, ("type: AveragePosition, object: cube, stiffness: 500 N/m",
            "type: SaturatedMesh, object: cube, stiffness: 500 N/m, limit: 2 N"),
)  # fmt: skip
AGED = replaced(
    (TOPOLOGIES / "three-users-scheduled.yaml").read_text(encoding="utf-8"),
    ("{count: 3}", "{count: 3, set: {device.x: [3 mm, -2 mm, 1 mm]}}"),
    ("loss: 0 %", "loss: 20 %, jitter: 3 ms"),
)  # fmt: skip

# Of a graph that isn't complete a sum is one product an arc, here and there: not a bit is different. Over a
# complete graph `simulate` takes the sum of all less its own.
EXACT = {"ring": RING, "pairs": PAIRS}
ROUNDED = {
    "moved": MOVED,
    "mixed clocks": MIXED,
    "late and lost, hold": LOSSY_HOLD,
    "packets that say how old they are": AGED,
    "paper": PAPER,
    "a delay inside a tick": INSIDE,
    "late and lost, zero": LOSSY,
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", EXACT)
def test_not_a_bit_of_its_forces_is_different(name: str, tmp_path: Path) -> None:
    assert worst(differences(compiled(EXACT[name]), tmp_path, duration="0.2 s")) == 0.0


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ROUNDED)
def test_its_forces_are_those_of_simulate_to_the_last_bits(name: str, tmp_path: Path) -> None:
    """A rounding of a sum over the others is all that differs, and what loops make of it in 0.4 s."""
    assert worst(differences(compiled(ROUNDED[name]), tmp_path, duration="0.2 s")) < 2e-13


@pytest.mark.whole
@pytest.mark.parametrize(
    "topology", ["planar-users", "two-users-waves", "two-users-passivity", "client-server"]
)
def test_so_are_those_of_other_couplers(topology: str, tmp_path: Path) -> None:
    text = (TOPOLOGIES / f"{topology}.yaml").read_text(encoding="utf-8").partition("\n")[2]
    device = "none" if topology == "client-server" else None
    off = differences(compiled(text), tmp_path, duration="0.2 s", device=device)
    assert max(gap for gap, _ in off.values()) < 1e-11


# The copy lies against a soft wall by a law of the power 1.5, at every moment.
BENT = replaced(
    MOVED,
    ("masses:\n", "masses:\n  stop: {mass: 1 kg, damping: 1 N*s/m}\n"),
    ("couplers:\n", "couplers:\n  soft: {type: HuntCrossleyContact, a: cube, b: ground, half_width: 1 mm,"
     " stiffness: 1e4 N/m^(3/2), damping: 10 N*s/m^(5/2)}\n"),
)  # fmt: skip


TIED = replaced(
    MOVED, ("type: SampledSpringDamper", "type: SpringDamper"), (", clock: haptic, delay: 1 ms}", "}")
)  # fmt: skip


def test_the_device_is_what_a_hand_holds() -> None:
    """A finger on a spring moves with it, so it is outside too; what is asked of a motor is no member."""
    plan = plan_of(apc.compile(TOPOLOGIES / "finger.yaml"), DEFAULT)
    peer = peer_of(plan, 0, DEFAULT, device=None)
    assert {peer.peer_type.states[row].name for row in peer.outside} >= {
        "device.x",
        "device.v",
        "finger.bone.x",
    }
    assert [force.name for force in peer.forces.values()] == ["device.f"]
    assert not any(signal.name == "device.asked" for signal in peer.signals)


@pytest.mark.whole
def test_what_is_not_linear_moves_by_the_same_steps(tmp_path: Path) -> None:
    off = differences(compiled(BENT), tmp_path, duration="0.1 s", method="rk4:0.25ms", device="device")
    assert worst(off) < 2e-13


@pytest.mark.whole
def test_nothing_in_it_changes_but_what_is_given(tmp_path: Path) -> None:
    """No data of its own that could be written, and nothing called but what computes."""
    plan = plan_of(compiled(PAPER), DEFAULT)
    code = peer_of(plan, 1, DEFAULT, device=None)
    build(code, tmp_path, ("-O2",))
    subprocess.run([compiler(), "-std=c99", "-c", f"{code.identifier}.c"], cwd=tmp_path, check=True)
    reported = subprocess.run(
        ["nm", f"{code.identifier}.o"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    peer_types = {line.split()[-2]: line.split()[-1] for line in reported.stdout.splitlines()}
    assert not set(peer_types) & set("dDbBCgGsS"), reported.stdout
    called = {line.split()[-1] for line in reported.stdout.splitlines() if line.split()[-2] == "U"}
    assert called <= {"_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}
    text = (tmp_path / f"{code.identifier}.c").read_text(encoding="ascii")
    included = {line for line in text.splitlines() if line.startswith("#include")}
    assert included == {f'#include "{code.identifier}.h"', "#include <math.h>"}


def test_the_loop_of_the_manual_compiles(tmp_path: Path) -> None:
    topology = str(TOPOLOGIES / "experiment-average.yaml")
    assert run(["export", topology, "--peer", "left[1]", "--out", str(tmp_path / "left.c")]) == 0
    text = (ROOT / "docs" / "howto" / "export.md").read_text(encoding="utf-8")
    _, _, after = text.partition("<!-- compiled with left.h of experiment-average.yaml -->\n```c\n")
    (tmp_path / "loop.c").write_text(after.partition("```")[0], encoding="ascii")
    subprocess.run(
        [compiler(), *STRICT, "-fsyntax-only", "loop.c", "left.c", "left_test.c"], cwd=tmp_path, check=True
    )


def test_numbers_of_any_size_and_none_do_no_harm(tmp_path: Path) -> None:
    """Under the sanitizers, what is measured and heard infinite, no number, tiny or huge."""
    plan = plan_of(compiled(LOSSY), DEFAULT)
    code = peer_of(plan, 0, DEFAULT, device=None)
    program = build(code, tmp_path, SANITIZED)
    some = np.random.default_rng(1).choice(
        [0.0, -0.0, 1e308, -1e308, 5e-324, float("inf"), float("-inf"), float("nan"), 1.0], (500, 6)
    )
    rows = "".join(
        f"{' '.join(map(repr, row[:4]))} {k % 2} {' '.join(map(repr, row[4:]))} {k % 3 // 2}\n"
        for k, row in enumerate(some.tolist())
    )
    done = subprocess.run([program], input=rows, capture_output=True, text=True, check=True)
    assert not done.stderr
    assert len(done.stdout.splitlines()) == 500


@pytest.mark.parametrize(
    ("text", "method", "device", "message"),
    [
        (BENT, "", None, "E961 user[1]: device and stop may be devices or object copies. "
                         "Try: --device device,stop, or --device device"),
        (BENT, "", "device", "E960 user[1]: cube.x, cube.v are integrated by CVODES between ticks, "
                             "which is not exported to C. Try: --method rk4:0.1ms"),
        (MOVED, "", "box", "E961 --device: unknown mass 'box' of user[1]. Try: --device cube"),
        (TIED, "", None, "E961 user[1]: device and cube are coupled between ticks, so cube can't be "
                         "computed while device is a physical device. Connect them by a part with a clock"),
    ],
)  # fmt: skip
def test_what_it_cannot_hold_is_named(text: str, method: str, device: str | None, message: str) -> None:
    how = parse_method(method) if method else DEFAULT
    with pytest.raises(ApcError) as error:
        peer_of(plan_of(compiled(text), how), 0, how, device=device)
    assert message in str(error.value)
