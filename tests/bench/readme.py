"""The pictures and printed blocks of README.md and the rooms' pages: this module makes them again.

A picture is drawn by the command that stands on one of the pages, a block is what the command in its mark
prints. The numbers of its prose about regions are those of `tests.bench.region`.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "runtime").glob("*/README.md")))

# How a command that draws a picture begins.
MAKERS = ("apc ", "python -m tests.bench.losses ", "python -m tests.bench.hands ")

BLOCK = re.compile(r"<!-- output: (?P<words>[^>]*) -->\n```text\n(?P<text>.*?)```", re.DOTALL)
# The block of a mistake: the topology shown, with this line broken.
ERROR, FINE, BROKEN = "error", "stiffness: 500 N/m", "stiffness: 500"


def whole() -> str:
    """Return all pages as one text, its links as they are from the first."""
    return "\n".join(page.read_text(encoding="utf-8").replace("](../../", "](") for page in PAGES)


def pictures(text: str) -> dict[str, list[str]]:
    """Return the words that draw each picture of models/figures, as they stand in the text.

    A command that writes to regions.svg draws models/figures/regions.svg; where it names its picture another
    way, the picture's own name tells the scene that is played.
    """
    shown = dict.fromkeys(re.findall(r"!\[[^]]*\]\(([^)]+)\)", text))
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    commands = [shlex.split(block.replace("\\\n", " ")) for block in blocks if block.startswith(MAKERS)]
    found = {}
    for picture in shown:
        name = Path(picture).name
        for words in commands:
            if words[-2:] == ["--out", name]:
                found[picture] = [*words[:-1], picture]
        played = re.search(r"`(apc simulate [^`]* --plot )[^`]*`", text)
        if picture not in found and played and (ROOT / "models/scenes" / f"{Path(name).stem}.yaml").is_file():
            words = shlex.split(played.group(1))
            words[2] = f"models/scenes/{Path(name).stem}.yaml"
            found[picture] = [*words, picture]
    return found


def printed(words: str, text: str) -> str:
    """Return what stands in the block with such a mark."""
    if words != ERROR:
        return _run(shlex.split(words), ROOT).stdout
    topology = re.search(r"```yaml\n(topology:.*?)```", text, re.DOTALL)
    assert topology
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "three-users.yaml").write_text(
            topology.group(1).replace(FINE, BROKEN), encoding="utf-8"
        )
        return _run(["apc", "check", "three-users.yaml"], Path(folder)).stderr


def _run(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    assert words[0] in {"apc", "python"}
    module = words if words[0] == "apc" else words[2:]
    return subprocess.run(
        [sys.executable, "-m", *module], cwd=folder, capture_output=True, text=True, check=False
    )


def main() -> None:
    """Draw and write everything; say what is other than before."""
    text, failed = whole(), 0
    for picture, words in pictures(text).items():
        before = (ROOT / picture).read_bytes() if (ROOT / picture).is_file() else b""
        ran = _run(words, ROOT)
        failed += ran.returncode != 0
        same = (ROOT / picture).read_bytes() == before
        print(f"{picture:<42} {'FAILED' if ran.returncode else 'as before' if same else 'new'}")
        if ran.returncode:
            print(ran.stderr)

    def again(block: re.Match[str]) -> str:
        new = printed(block["words"], text)
        print(f"{block['words']:<42} {'as before' if new == block['text'] else 'new'}")
        return f"<!-- output: {block['words']} -->\n```text\n{new}```"

    for page in PAGES:
        page.write_text(BLOCK.sub(again, page.read_text(encoding="utf-8")), encoding="utf-8")
    raise SystemExit(bool(failed))


if __name__ == "__main__":
    main()
