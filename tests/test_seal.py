"""Claims about `apc.compiler.seal`: what is sealed was written by this user, or nothing is."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from apc.compiler import seal as module
from apc.compiler.seal import LENGTH, SECRET, cache_folder, is_sealed, seal


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "apc"


def forget() -> None:
    """Be another process of the same user."""
    module._secret.cache_clear()


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_seal_holds_for_the_bytes_it_was_made_of_alone(folder: Path) -> None:
    found = seal(b"one")
    forget()
    assert is_sealed(b"one", found)
    assert not is_sealed(b"two", found)
    assert not is_sealed(b"one", "")
    assert not is_sealed(b"one", "é")
    assert len((folder / SECRET).read_bytes()) == LENGTH
    assert (mode(folder), mode(folder / SECRET)) == (0o700, 0o600)
    assert [path.name for path in folder.iterdir()] == [SECRET]


def test_another_users_seal_does_not_hold(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = seal(b"one")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert not is_sealed(b"one", found)
    assert seal(b"one") != found


@pytest.mark.parametrize("content", [b"", b"known", b"x" * (LENGTH + 1)])
def test_a_secret_that_is_none_is_made_anew(folder: Path, content: bytes) -> None:
    cache_folder()
    (folder / SECRET).write_bytes(content)
    (folder / SECRET).chmod(0o600)
    forget()
    assert is_sealed(b"one", seal(b"one"))
    assert len((folder / SECRET).read_bytes()) == LENGTH


def test_a_secret_that_others_may_have_read_is_made_anew(folder: Path) -> None:
    found = seal(b"one")
    (folder / SECRET).chmod(0o644)
    forget()
    assert not is_sealed(b"one", found)
    assert mode(folder / SECRET) == 0o600


def test_a_folder_that_others_can_read_is_closed(folder: Path) -> None:
    folder.mkdir(parents=True, mode=0o755)
    assert cache_folder() == folder
    assert mode(folder) == 0o700


def test_without_a_folder_of_ones_own_nothing_is_sealed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "cache").write_text("a file", encoding="utf-8")
    assert cache_folder() is None
    assert seal(b"one") == ""
    assert not is_sealed(b"one", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "link"))
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "apc").symlink_to(tmp_path / "elsewhere")
    assert cache_folder() is None
    mine = os.geteuid()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "theirs"))
    (tmp_path / "theirs" / "apc").mkdir(parents=True, mode=0o700)
    monkeypatch.setattr(os, "geteuid", lambda: mine + 1)
    assert cache_folder() is None


def test_the_folder_is_where_the_system_keeps_such_things(monkeypatch: pytest.MonkeyPatch) -> None:
    assert module._folder() == Path(os.environ["XDG_CACHE_HOME"]) / "apc"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert module._folder() == Path.home() / ".cache" / "apc"
