# ruff: noqa: E501 -- scenes are written by long lines
"""Scenes that grow: more peers, different peers, kinds, equations.

Takes: how many, and a folder for what stands beside a scene. Gives: `flat`, `table`, `kinds`, `equations`.
Does not: load anything large, so that what measures whole processes can use it.
"""

from __future__ import annotations

from pathlib import Path

SCENES = Path(__file__).resolve().parents[2] / "models" / "scenes"
AVERAGE = (SCENES / "three-users-average.yaml").read_text(encoding="utf-8")


def flat(peers: int, folder: Path) -> str:
    """Return a scene of equal peers."""
    return _replaced(("count: 3", f"count: {peers}"))


def table(peers: int, folder: Path) -> str:
    """Return a scene of different peers, a row each, and write their table."""
    rows = "\n".join(f"{0.1 + 1e-7 * i:.7f},{5 + i % 7},{800 + i % 1000}" for i in range(peers))
    headings = "device.mass [kg],device.damping [N*s/m],contact.stiffness [N/m]"
    (folder / "many.csv").write_text(f"{headings}\n{rows}\n", encoding="utf-8")
    return _replaced(("{count: 3}", "{table: many.csv}"))


def kinds(number: int, folder: Path) -> str:
    """Return a scene of groups that each have one hand more or fewer, so that each is a kind."""
    groups = "".join(f"  g{i}: {{count: 3}}\n" for i in range(number))
    hands = "".join(
        f"  h{i}: {{type: SpringDamperArm, flange: device, stiffness: 10 N/m, damping: 1 N*s/m, at: [g{i}]}}\n"
        for i in range(number)
    )
    return _replaced(("  user: {count: 3}\n", groups), ("studies:", f"hands:\n{hands}studies:"))


def equations(number: int, folder: Path) -> str:
    """Return a scene with one component of so many equations: a chain of masses and springs, written out."""
    masses = max(1, number // 3)
    names = range(1, masses + 1)
    variables = "".join(
        f"  x{i}: {{unit: m, start: 0}}\n  v{i}: {{unit: m/s, start: 0}}\n  f{i}: {{unit: N}}\n"
        for i in names
    )
    lines = []
    for i in names:
        before = "flange.x" if i == 1 else f"x{i - 1}"
        lines += [
            f"  - der(x{i}) = v{i}",
            f"  - f{i} = stiffness*({before} - x{i})",
            f"  - mass*der(v{i}) = f{i} - damping*v{i}" + (f" - f{i + 1}" if i < masses else ""),
        ]
    return _with_chain("\n".join(lines) + "\n  - flange.f = f1\n", variables, folder)


def _with_chain(lines: str, variables: str, folder: Path) -> str:
    """Return the scene with a component of these equations at each device, and write the component."""
    (folder / "parts").mkdir(exist_ok=True)
    text = (
        "component: Chain\nabout: Masses in a row, held together by springs.\nconnectors: {flange: Flange}\nparameters:\n"
        "  stiffness: {unit: N/m, min: 0}\n  damping: {unit: N*s/m, min: 0}\n  mass: {unit: kg, above: 0}\nvariables:\n"
        + variables + "equations:\n" + lines
    )  # fmt: skip
    (folder / "parts" / "chain.yaml").write_text(text, encoding="utf-8")
    chain = (
        "hands:\n  chain: {type: Chain, flange: device, stiffness: 10 N/m, damping: 1 N*s/m, mass: 10 g}\n"
    )
    return _replaced(("clocks:", "library: parts\nclocks:"), ("studies:", f"{chain}studies:"))


def _replaced(*pairs: tuple[str, str]) -> str:
    """Return the paper's scene with each (old, new) pair replaced; every old one must be there."""
    text = AVERAGE
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text
