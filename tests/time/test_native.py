"""Machine code where there is a compiler, of this user alone, and none otherwise."""

from __future__ import annotations

import ctypes
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from apc.compiler import signing
from apc.simulation import c_compiler as module
from apc.simulation.c_compiler import compiler, native
from tests.topologies import ROOT


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(signing, "_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


TEXT = "double half(double x) { return x / 2; }\n"


def half(library: ctypes.CDLL | None) -> float:
    assert library is not None
    library.half.restype, library.half.argtypes = ctypes.c_double, [ctypes.c_double]
    return float(library.half(3.0))


needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@needs_compiler
def test_what_was_compiled_once_is_found_again(cache: Path) -> None:
    native(TEXT)
    before = {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in cache.iterdir()}
    assert sorted(Path(name).suffix for name in before) == ["", ".seal", ".so"]
    native(TEXT)
    assert before == {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in cache.iterdir()}


@needs_compiler
def test_a_linker_opens_nothing_of_the_working_folder(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "TIMEOUT", 5.0)
    for name in ("libgcc_s.so.1", "libm.so.6", "libc.so.6"):
        os.mkfifo(name)  # who opens it waits for ever
    assert half(native(TEXT)) == 1.5


@pytest.mark.whole
@needs_compiler
@pytest.mark.parametrize("part", [7, 0, 13, 19])
def test_a_library_with_a_bit_turned_is_compiled_again(cache: Path, part: int) -> None:
    native(TEXT)
    [library] = cache.glob("*.so")
    # Written anew under its name: a library that this process has loaded stays what it is.
    whole = library.read_bytes()
    data = bytearray(whole)
    data[len(data) * part // 20] ^= 1 << part % 8
    library.unlink()
    library.write_bytes(data)
    ran = subprocess.run(
        [sys.executable, "-c", AGAIN, str(cache)], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert (ran.stdout.strip(), ran.returncode) == ("1.5", 0), ran.stderr
    assert library.read_bytes() == whole


AGAIN = """
import sys
from pathlib import Path
from apc.compiler import signing
from tests.time.test_native import TEXT, half, native
signing._folder = lambda: Path(sys.argv[1])
print(half(native(TEXT)))
"""


@needs_compiler
def test_a_library_that_somebody_else_put_there_is_not_loaded(cache: Path) -> None:
    native(TEXT)
    [library], [mark] = cache.glob("*.so"), cache.glob("*.seal")
    whole = library.read_bytes()
    library.unlink()
    library.write_bytes(b"another library")
    mark.write_text(hashlib.sha256(b"another library").hexdigest(), encoding="ascii")
    assert half(native(TEXT)) == 1.5
    assert library.read_bytes() == whole


@needs_compiler
def test_a_folder_of_another_user_is_not_used(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.mkdir(mode=0o700)
    mine = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: mine + 1)
    assert native(TEXT) is None
    assert list(cache.iterdir()) == []


@needs_compiler
@pytest.mark.parametrize("above", [False, True])
def test_a_folder_that_others_can_write_to_is_not_used(cache: Path, above: bool) -> None:
    cache.mkdir(mode=0o700)
    (cache.parent if above else cache).chmod(0o777)
    assert native(TEXT) is None
    assert list(cache.iterdir()) == []


@needs_compiler
def test_without_a_compiler_or_a_folder_to_keep_it_in_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setattr(signing, "_folder", lambda: tmp_path / "file" / "cache")
    assert native(TEXT) is None
    monkeypatch.setattr(module, "compiler", lambda: None)
    assert native(TEXT) is None
