"""The stages `flat` and `sorted` of five scenes, as files that were read and found right.

When a change of the compiler is meant to change them: `python -m tests.test_golden` writes them again; read
the difference before it is committed, equation by equation. They say how the text of a scene becomes
equations; that the numbers are right is tested elsewhere, against closed forms.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from apc.compiler.pipeline import Stage, run_stages
from apc.compiler.view.stages import describe
from tests.topologies import ROOT, SCENES

GOLDEN = ROOT / "tests" / "golden"
NAMES = ("three-users-average", "three-users-mesh", "experiment-average", "finger", "mixed-clocks")
STAGES: tuple[Stage, ...] = ("flat", "sorted")

# What a person or a file gets of the five scenes, as one digest.
DIGEST = f"""
import hashlib, pathlib
from apc.api import save, schema, show
from apc.compiler.view.stages import describe
from apc.compiler.pipeline import each_stage
whole = hashlib.sha256(repr(schema()).encode())
for name in {NAMES!r}:
    path = pathlib.Path({str(SCENES)!r}) / f"{{name}}.yaml"
    for stage, value in each_stage(path):
        whole.update(describe(value).encode())
    save(value, pathlib.Path("scene.apc"))
    whole.update(pathlib.Path("scene.apc").read_bytes())
    for form in ("text", "json", "dot", "svg"):
        whole.update(show(path, format=form).encode())
print(whole.hexdigest())
"""


def text_of(name: str, stage: Stage) -> str:
    """Return a stage of a scene as text."""
    return describe(run_stages(SCENES / f"{name}.yaml", until=stage)) + "\n"


def file_of(name: str, stage: Stage) -> Path:
    """Return the file that holds it."""
    return GOLDEN / f"{name}.{stage}.txt"


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("name", NAMES)
def test_a_scene_becomes_the_equations_that_were_found_right(name: str, stage: Stage) -> None:
    assert text_of(name, stage) == file_of(name, stage).read_text(encoding="utf-8")


def test_there_is_no_golden_file_besides() -> None:
    assert sorted(GOLDEN.iterdir()) == sorted(file_of(name, stage) for name in NAMES for stage in STAGES)


def test_the_same_scene_gives_the_same_bytes_whatever_the_order_of_hashes(tmp_path: Path) -> None:
    digests = set()
    for seed in ("0", "4242"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", DIGEST]
        ran = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, ran.stderr
        digests.add(ran.stdout)
    assert len(digests) == 1


if __name__ == "__main__":
    for name in NAMES:
        for stage in STAGES:
            file_of(name, stage).write_text(text_of(name, stage), encoding="utf-8")
