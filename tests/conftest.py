"""What holds for all tests: none of them depends on time, so a busy machine changes no outcome.

None depends on another either, or on what the user keeps: they run in several processes at once.

A test marked `whole` runs with `pytest --whole` only: it is slow, or about the inside of a deep proof. One
marked `few(count)` has more cases than its claim needs each time: so many of them run, chosen to show as many
values of each parameter as they can, and all of them with `pytest --whole`. One marked
`needs_extension(name, …)` does not run where one of these extensions, or any of `all`, is hidden
(`pytest --without-extension NAME`).
"""

from __future__ import annotations

import gc
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from apc.support.extension_table import EXTENSIONS, FOLDER
from tests.commands import Cli, Ran
from tests.hidden import HiddenExtensions

HIDDEN = pytest.StashKey[set[str]]()

# How long an example takes, or the making of one, says nothing of whether a claim is true.
settings.register_profile("apc", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("apc")

# What a shell starts in the background is deaf to Ctrl-C, and so would be all that a test ends by it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection() -> None:
    gc.disable()


def pytest_collection_finish() -> None:
    """All that was collected stays until the end: it is not looked through for garbage again and again."""
    gc.freeze()
    gc.enable()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--whole", action="store_true", help="run every test, and every case of those marked few"
    )
    parser.addoption(
        "--without-extension",
        action="append",
        default=[],
        help="hide an extension, or `all`, and run the tests that need none of the hidden ones",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Hide extensions from import."""
    names = config.getoption("--without-extension")
    config.stash[HIDDEN] = {*EXTENSIONS} if "all" in names else {*names}
    if config.stash[HIDDEN]:
        sys.meta_path.insert(0, HiddenExtensions(config.stash[HIDDEN]))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Ignore a file of tests that imports a hidden extension."""
    if not config.stash[HIDDEN] or collection_path.suffix != ".py":
        return None
    text = collection_path.read_text(encoding="utf-8")
    return any(f"from {FOLDER}.{name}" in text for name in config.stash[HIDDEN]) or None


@pytest.hookimpl(trylast=True)  # of what is selected otherwise
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    missing = {
        item
        for item in items
        for mark in item.iter_markers("needs_extension")
        if not config.stash[HIDDEN].isdisjoint(EXTENSIONS if "all" in mark.args else mark.args)
    }
    config.hook.pytest_deselected(items=[item for item in items if item in missing])
    items[:] = [item for item in items if item not in missing]
    if config.getoption("--whole"):
        return
    marked: dict[str, tuple[int, list[pytest.Function]]] = {}
    limitations = {item for item in items if item.get_closest_marker("whole")}
    for item in items:
        mark = item.get_closest_marker("few")
        if mark and item not in limitations and isinstance(item, pytest.Function):
            marked.setdefault(item.nodeid.partition("[")[0], (mark.args[0], []))[1].append(item)
    limitations |= {item for count, cases in marked.values() for item in {*cases} - {*few(cases, count)}}
    config.hook.pytest_deselected(items=[item for item in items if item in limitations])
    items[:] = [item for item in items if item not in limitations]


def few(cases: list[pytest.Function], count: int) -> list[pytest.Function]:
    """Return so many cases, each the first of those that show most values not shown yet."""
    values = {case: {(name, repr(value)) for name, value in case.callspec.params.items()} for case in cases}
    stored: list[pytest.Function] = []
    rest, shown = [*cases], set[tuple[str, str]]()
    while rest and len(stored) < count:
        best = max(rest, key=lambda case: len(values[case] - shown))
        rest.remove(best)
        stored.append(best)
        shown |= values[best]
    return stored


@pytest.fixture(scope="session", autouse=True)
def users_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what apc keeps for a user in a folder of this process, and not among the user's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        # Nothing is said of how far work is, however long it takes.
        patch.setattr("apc.cli.progress.QUIET", float("inf"))
        # Processes that tests start keep what Python compiled, as where apc is installed.
        patch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
        yield


@pytest.fixture
def cli(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Cli:
    """Run commands in an empty folder, each a line as for a shell, or its words."""
    from apc.__main__ import run

    monkeypatch.chdir(tmp_path)

    def call(line: str, *words: str) -> Ran:
        capsys.readouterr()
        code = run([*shlex.split(line), *words])
        return Ran(code, *capsys.readouterr())

    return call


@pytest.fixture
def refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """Return what gives a topology's text to `apc export` with words that it refuses, and what it says
    then.
    """
    from apc.__main__ import run

    def export(text: str, *words: str) -> str:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "topology.yaml").write_text(text, encoding="utf-8")
        assert run(["export", *words]) == 1
        assert [path.name for path in tmp_path.iterdir()] == ["topology.yaml"]
        return capsys.readouterr().err

    return export
