"""Scenes that grow: more peers, different peers.

Takes: how many, and a folder for what stands beside a scene. Gives: `flat`, `table`.
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


def _replaced(*pairs: tuple[str, str]) -> str:
    """Return the paper's scene with each (old, new) pair replaced; every old one must be there."""
    text = AVERAGE
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text
