"""A copy of the product and its tests, and runs of tests in it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def product_copy(folder: Path) -> Path:
    """Copy the product and the tests, and lay `lib/apc` out as the package is installed."""
    keep = shutil.ignore_patterns("__pycache__", "*.apc", "_build")
    for name in ("compiler", "runtime", "models", "tests", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=keep)
    for name in ("pyproject.toml", "setup.py", "README.md", "CHANGELOG.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    package = folder / "lib" / "apc"
    package.mkdir(parents=True)
    for path in (folder / "runtime").iterdir():
        (package / path.name).symlink_to(path)
    for name in ("compiler", "models"):
        (package / name).symlink_to(folder / name)
    return folder


def run_tests(copy: Path, words: list[str], limit: float | None) -> int | None:
    """Return the exit code of a run of tests in a copy, or None if it was stopped at the limit (s)."""
    environment = os.environ | {
        "PYTHONPATH": str(copy / "lib"),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "TMPDIR": str(copy / "tmp"),
    }
    (copy / "tmp").mkdir(exist_ok=True)
    command = [sys.executable, str(copy / "tests" / "mutants" / "reach.py"), *words]
    with (copy / "log.txt").open("w") as log:
        process = subprocess.Popen(
            command, cwd=copy, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, 9)
                process.wait()
            shutil.rmtree(copy / "tmp", ignore_errors=True)
