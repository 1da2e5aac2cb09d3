"""`files`: what is no bounded file is not read, and what is written replaces nothing but a file."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import pytest

import apc
from apc.__main__ import run
from apc.cli import commands
from apc.compiler import files
from apc.compiler.errors import ApcError
from apc.compiler.files import (
    RefusedError,
    begin_file,
    drop_file,
    finish_file,
    read_file,
    write_file,
    write_texts,
)
from tests.topologies import AVERAGE, ROOT, replaced, told

FIFO = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")


def test_a_file_is_read_up_to_its_limit_and_nothing_is_opened_that_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_bytes(b"x" * 100)
    (tmp_path / "link").symlink_to("a")
    assert read_file(tmp_path / "link", 100) == b"x" * 100
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "cpu").symlink_to("/proc/cpuinfo")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RefusedError, match="is larger than 99 bytes, the most it may have"):
        read_file(tmp_path / "link", 99)
    monkeypatch.setattr(files, "_without_waiting", None)  # opening anything would fail otherwise
    for name, words in (
        ("pipe", "is a device, pipe or socket"),
        ("zero", "is a device, pipe or socket"),
        ("cpu", "is an answer of the system's kernel"),
        ("", "is a folder"),
        ("none", "does not exist"),
        ("n" * 300, "File name too long"),
    ):
        with pytest.raises(RefusedError, match=words):
            read_file(tmp_path / name, 100)


def fill(text: str) -> object:
    return lambda temporary: temporary.write_text(text, encoding="utf-8")


def test_a_file_keeps_its_mode_and_a_new_one_has_that_of_the_mask(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    before = os.umask(0o027)
    try:
        write_file(path, fill("one"))
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
        path.chmod(0o600)
        write_file(path, fill("two"))
    finally:
        os.umask(before)
    assert (stat.S_IMODE(path.stat().st_mode), path.read_text()) == (0o600, "two")
    assert [one.name for one in tmp_path.iterdir()] == ["r.csv"]


def test_a_link_stays_and_its_file_is_written(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "r.csv").symlink_to("there/real.csv")
    write_file(tmp_path / "r.csv", fill("new"))
    assert (tmp_path / "r.csv").is_symlink()
    assert (tmp_path / "there" / "real.csv").read_text() == "new"
    assert [one.name for one in (tmp_path / "there").iterdir()] == ["real.csv"]


def test_of_a_failure_nothing_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("before", encoding="utf-8")

    def fail(temporary: Path) -> None:
        temporary.write_text("half", encoding="utf-8")
        raise OSError(28, "No space left on device")

    assert told(write_file, path, fail) == [f"{path}: E601 can't be written: No space left on device."]
    assert path.read_text() == "before"
    assert [one.name for one in tmp_path.iterdir()] == ["r.csv"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("", "it is a folder"),
        ("none/r.csv", "No such file or directory"),
        ("x" * 300, "File name too long"),
        ("\0", "embedded null"),
        ("round", "its links lead to one another"),
    ],
)
def test_where_nothing_can_be_written_is_told(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "round").symlink_to("round")
    (message,) = told(write_file, tmp_path / name, fill(""))
    assert f": E601 can't be written: {why}" in message


def reading(pipe: Path, into: list[bytes]) -> threading.Thread:
    """Start to read a pipe, as another program does."""
    thread = threading.Thread(target=lambda: into.append(pipe.read_bytes()))
    thread.start()
    return thread


@FIFO
def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe, found = tmp_path / "pipe.csv", []
    os.mkfifo(pipe)
    other = reading(pipe, found)
    write_file(pipe, fill("through"))
    other.join()
    assert found == [b"through"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert [one.name for one in tmp_path.iterdir()] == ["pipe.csv"]


def test_a_device_is_written_to_and_stays_a_device(tmp_path: Path) -> None:
    link = tmp_path / "null.csv"
    link.symlink_to(os.devnull)
    before = Path(os.devnull).stat()
    write_file(link, fill("gone"))
    temporary = begin_file(Path(os.devnull))
    assert temporary.parent != Path(os.devnull).parent, "nothing is made among the devices"
    finish_file(temporary, Path(os.devnull))
    assert not temporary.exists()
    after = Path(os.devnull).stat()
    assert (before.st_ino, before.st_mode) == (after.st_ino, after.st_mode)
    assert link.is_symlink()


def test_standard_output_is_written_to_whatever_it_is_and_goes_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.csv"
    log.write_text("kept\n", encoding="utf-8")
    before = os.dup(1)
    with log.open("ab") as stream:  # as `>> log.csv` does
        os.dup2(stream.fileno(), 1)
    try:
        for path in (Path("/dev/stdout"), log):
            write_file(path, fill("rows\n"))
        assert files.partial_name(log) == log
        os.write(1, b"more\n")
    finally:
        os.dup2(before, 1)
        os.close(before)
    assert log.read_text() == "kept\nrows\nrows\nmore\n"
    assert [one.name for one in tmp_path.iterdir()] == ["log.csv"]
    assert capfd.readouterr() == ("", "")


@FIFO
def test_a_pipe_that_is_but_a_descriptor_is_written_to(tmp_path: Path) -> None:
    there, here = os.pipe()
    link = tmp_path / "link.csv"
    link.symlink_to(f"/dev/fd/{here}")  # what `--out >(gzip)` leads to
    write_file(link, fill("through"))
    os.close(here)
    with os.fdopen(there, "rb") as stream:
        assert stream.read() == b"through"


# ---- through the command line ----

TABLE = "device.mass [kg]\n0.1\n0.2\n"
WITH_TABLE = replaced(AVERAGE, ("{count: 3}", "{table: users.csv}"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    yield tmp_path


def failed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Run a command that must fail with code 1, and return the first line of what it says."""
    code = run(list(words))
    out, err = capsys.readouterr()
    assert (code, out) == (1, ""), err
    return err.splitlines()[0]


@FIFO
def test_a_pipe_as_a_model_or_as_a_table_is_not_waited_for(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo("scene.apc")
    assert run(["analyze", "scene.yaml"]) == 0
    capsys.readouterr()
    assert "E602 is a device, pipe or socket, not a compiled model." in failed(capsys, "analyze", "scene.apc")
    os.mkfifo("users.csv")
    Path("scene.yaml").write_text(WITH_TABLE, encoding="utf-8")
    assert "E701 the table users.csv is a device, pipe or socket." in failed(capsys, "check")


@FIFO
def test_a_model_is_never_compiled_into_what_is_none(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whoever packed a folder may have put anything under the model's name."""
    model, own = Path("scene.apc"), Path("own.txt")
    own.write_text("mine", encoding="utf-8")
    os.mkfifo("pipe")
    link = "scene.apc: E601 can't be written: it is a link to what is no compiled model. Write: rm scene.apc"
    special = "scene.apc: E601 can't be written: it is a device, pipe or socket. Write: rm scene.apc"
    for target, message in ((own, link), ("new.txt", link), ("pipe", special), ("/dev/zero", special)):
        model.symlink_to(target)
        assert failed(capsys, "compile", "scene.yaml") == message
        model.unlink()
    os.mkfifo(model)
    assert failed(capsys, "compile", "scene.yaml") == special
    model.unlink()
    assert own.read_text() == "mine" and not Path("new.txt").exists()
    model.symlink_to("other.apc")
    assert run(["compile", "scene.yaml"]) == 0
    assert model.is_symlink() and Path("other.apc").is_file()


@pytest.mark.parametrize(
    ("library", "message"),
    [
        ("/proc/self", "E214 the library folder /proc/self is an answer of the system's kernel."),
        ("/", "E214 the library folder / holds more than 3 files and folders. Write: library: ./parts"),
        ("deep", "E214 the library folder deep is more than 2 folders deep"),
    ],
)
def test_a_folder_without_end_is_no_library(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, library: str,
    message: str,
) -> None:  # fmt: skip
    Path("deep/a/b/c").mkdir(parents=True)
    Path("scene.yaml").write_text(f"library: {library}\n{AVERAGE}", encoding="utf-8")
    monkeypatch.setattr(files, "MOST_ENTRIES", 9 if library == "deep" else 3)
    monkeypatch.setattr(files, "MOST_DEPTH", 2)
    assert message in failed(capsys, "check", "scene.yaml")


SECRET = "root:$6$abc:19000:0:99999:7:::"


@pytest.mark.parametrize(
    "text",
    [
        f"{SECRET}\ndaemon:*:19000:0:99999:7:::\n",
        f"ghp_{'S' * 30}\n",
        f"ghp_S\n{SECRET}\n",
        f"[{SECRET}]\nuser = {SECRET}\n",
        f"KEY={SECRET},1\n2\n",
        '"unclosed' + "S" * 200_000,
    ],
)
def test_a_file_that_is_no_table_is_told_without_its_text(
    folder: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    Path("users.csv").write_text(text, encoding="utf-8")
    for old, new in (
        ("{count: 3}", "{table: users.csv}"),
        ("delay: 8 ms}", "delay: 8 ms, trace: users.csv}"),
    ):
        Path("scene.yaml").write_text(replaced(AVERAGE, (old, new)), encoding="utf-8")
        assert run(["check"]) == 1
        err = capsys.readouterr().err
        assert "E70" in err
        assert "root" not in err and "SS" not in err and "ghp" not in err


def test_a_library_file_about_something_else_is_told_without_its_text(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("parts").mkdir()
    Path("parts/config.yaml").write_text(f"token: [{SECRET}\nroot: {{\n", encoding="utf-8")
    Path("scene.yaml").write_text(f"library: ./parts\n{AVERAGE}", encoding="utf-8")
    message = "E219 a file of a library wants YAML that defines a component or connector."
    assert run(["check"]) == 1
    err = capsys.readouterr().err
    assert message in err and "root" not in err


# Every option that names a file to write, with what else its command wants.
WRITING = {
    ("analyze", "--plot"): ("scene.yaml", "new.svg"),
    ("bench", "--plot"): ("scene.yaml", "new.svg"),
    ("compare", "--out"): ("scene.yaml", "new.json"),
    ("critical", "--plot"): ("contact.stiffness", "scene.yaml", "new.svg"),
    ("export", "--out"): ("scene.yaml", "new.npz"),
    ("feel", "--out"): ("scene.yaml", "new.csv"),
    ("network", "--out"): ("delays.csv", "new.csv"),
    ("region", "--out"): ("scene.yaml", "--x", "contact.stiffness=1 N/m:2 N/m", "--y",
                          "coordination.stiffness=1 N/m:2 N/m", "new.csv"),
    ("report", "--out"): ("scene.yaml", "new.html"),
    ("show", "--out"): ("scene.yaml", "new.txt"),
    ("simulate", "--out"): ("scene.yaml", "--duration", "40 ms", "new.csv"),
    ("simulate", "--plot"): ("scene.yaml", "--duration", "40 ms", "new.svg"),
    ("simulate", "--still"): ("scene.yaml", "--duration", "40 ms", "new.svg"),
    ("sweep", "--out"): ("scene.yaml", "--over", "contact.stiffness=1 N/m:2 N/m:2", "--jobs", "1", "new.csv"),
}  # fmt: skip
# A folder, which has a test of its own; written by no scene; read and not written.
OTHERS = {("play", "--out"), ("schema", "--out"), ("play", "--device"), ("play", "--secret-file"),
          ("bench", "--hard"), ("report", "--check")}  # fmt: skip


def writing(command: tuple[str, str]) -> list[str]:
    """Return the words of a command that writes a file, which is the last of them."""
    *words, target = WRITING[command]
    return [command[0], *words, command[1], target]


def test_every_option_that_names_a_file_to_write_is_known_here() -> None:
    context = click.Context(commands.apc)
    found = {
        (name, option.opts[0])
        for name in commands.apc.list_commands(context)
        for option in commands.apc.get_command(context, name).params
        if isinstance(option.type, click.Path)
    }
    assert found == {*WRITING, *OTHERS}


@pytest.fixture
def inputs(folder: Path) -> tuple[Path, ...]:
    """Return what a command reads: the topology, its table and compiled model, a recording."""
    Path("users.csv").write_text(TABLE, encoding="utf-8")
    Path("scene.yaml").write_text(WITH_TABLE, encoding="utf-8")
    Path("delays.csv").write_text("delay [ms]\n1\n2\nlost\n3\n", encoding="utf-8")
    assert run(["compile", "scene.yaml"]) == 0
    return tuple(Path(name) for name in ("scene.yaml", "users.csv", "scene.apc", "delays.csv"))


@pytest.mark.parametrize("command", [*WRITING, ("schema", "--out")])
def test_a_link_to_what_a_command_reads_is_refused_and_a_file_that_is_read_only_stays(
    inputs: tuple[Path, ...], capsys: pytest.CaptureFixture[str], command: tuple[str, str]
) -> None:
    before = [one.read_bytes() for one in inputs]
    words = writing(command) if command in WRITING else [*command, "new.json"]
    target = Path(words[-1])
    capsys.readouterr()
    for read in {"network": inputs[3:], "schema": ()}.get(command[0], inputs[:3]):
        for link in (target.symlink_to, target.hardlink_to):
            link(read)
            assert f"{target}: E616 is read by this command" in failed(capsys, *words)
            target.unlink()
    assert [one.read_bytes() for one in inputs] == before
    target.write_text("mine", encoding="utf-8")
    target.chmod(0o444)
    assert failed(capsys, *words) == f"{target}: E601 can't be written: it is read-only."
    assert target.read_text() == "mine"
    assert not list(Path().glob(".*"))


def test_beside_what_is_asked_for_nothing_that_is_read_is_replaced(
    inputs: tuple[Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    for words, beside in (
        (["export", "scene.yaml", "--peer", "user[1]", "--out", "new.c"], ("new.h", "new_test.c")),
        (["simulate", "scene.yaml", "--duration", "40 ms", "--out", "new.csv"], ("new.csv.json",)),
    ):
        for name in beside:
            Path(name).symlink_to("scene.apc")
            capsys.readouterr()
            assert f"{name}: E616 is read by this command" in failed(capsys, *words)
            Path(name).unlink()
    capsys.readouterr()
    assert "E973 holds the scene that is played" in failed(
        capsys, "play", "scene.yaml", "--duration", "40 ms", "--out", "."
    )


# ---- what a writer that was killed has left ----

KILLED = """
import os, signal, sys
from pathlib import Path
from apc.compiler.files import write_file

def write(temporary):
    temporary.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)

write_file(Path(sys.argv[1]), write)
"""


def kill_a_writer(path: Path) -> None:
    ran = subprocess.run([sys.executable, "-c", KILLED, str(path)], cwd=ROOT, check=False)
    assert ran.returncode == -signal.SIGKILL


def test_what_killed_writers_left_goes_with_the_next(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    held = begin_file(path)
    kill_a_writer(path)
    kill_a_writer(path)  # which takes the place of the one before
    assert len(list(tmp_path.iterdir())) == 2
    drop_file(held)
    kill_a_writer(path)
    assert len(list(tmp_path.iterdir())) == 1
    write_file(path, fill("whole"))
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("r.csv", "whole")]


def test_what_others_are_writing_stays(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    first, second = begin_file(path), begin_file(path)
    first.write_text("first", encoding="utf-8")
    write_file(path, fill("third"))
    second.write_text("second", encoding="utf-8")
    finish_file(first, path)
    assert path.read_text() == "first"
    finish_file(second, path)
    assert path.read_text() == "second"
    assert [one.name for one in tmp_path.iterdir()] == ["r.csv"]


@FIFO
def test_what_is_no_file_of_ours_is_no_temporary(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    name = begin_file(path)
    drop_file(name)
    (tmp_path / "mine.txt").write_text("mine", encoding="utf-8")
    for make in (os.mkfifo, Path.mkdir, lambda one: one.symlink_to("mine.txt")):
        make(name)
        write_file(path, fill("whole"))
        assert os.path.lexists(name)
        name.rmdir() if name.is_dir() else name.unlink()
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_of_many_writers_at_once_each_writes_it_whole(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    texts = {str(number) * 10_000 for number in range(8)}

    def write(text: str) -> None:
        for _ in range(20):
            write_file(path, fill(text))
            assert path.read_text() in texts

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, texts))
    assert [one.name for one in tmp_path.iterdir()] == ["r.csv"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "sweep scene.yaml --over contact.stiffness=1N/m:2N/m:2 --out users.csv",
            "users.csv: E616 is read by this command: --out would replace it. Write: --out users-result.csv",
        ),
        (
            "show scene.txt --out scene.txt",
            "scene.txt: E616 is read by this command: --out would replace it. Write: --out scene-result.txt",
        ),
        (
            "simulate scene.yaml --duration 1s --plot a.png --still ./a.png",
            "a.png: E616 is given to --plot and to --still: the second would replace the first. "
            "Write: --still a-result.png",
        ),
    ],
)
def test_what_a_command_reads_it_never_replaces(
    inputs: tuple[Path, ...], capsys: pytest.CaptureFixture[str], words: str, message: str
) -> None:
    Path("scene.txt").write_text(AVERAGE, encoding="utf-8")
    capsys.readouterr()
    assert failed(capsys, *words.split()) == message
    assert Path("users.csv").read_text() == TABLE
    assert Path("scene.txt").read_text() == AVERAGE
    over = {"contact.stiffness": "1 N/m:2 N/m:2"}
    assert told(lambda: apc.sweep("scene.yaml", over, out="users.csv")) == [
        'users.csv: E616 is read by this command: out would replace it. Write: out="users-result.csv"'
    ]


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (
            ("sweep", "--over", "contact.stiffness=1 N/m:2 N/m:2", "--jobs", "1"),
            "contact.stiffness [N/m],verdict",
        ),
        (("simulate", "--duration", "10 ms", "--no-jit"), "time [s],"),
        (
            ("region", "--x", "contact.stiffness=0 N/m:9 N/m", "--y", "coordination.stiffness=0 N/m:9 N/m"),
            "panel,topology,",
        ),
        (("show",), "three-users-average"),
        (("schema",), "{"),
    ],
)
def test_a_device_takes_the_text_format_of_a_command_and_its_words_stand_beside(
    folder: Path, capfd: pytest.CaptureFixture[str], words: tuple[str, ...], start: str
) -> None:
    assert run([*words, "--out", "/dev/stdout"]) == 0
    out, err = capfd.readouterr()
    assert out.startswith(start)
    assert "/dev/stdout" in err
    assert "/dev/stdout" not in out
    assert run([*words, "--out", os.devnull]) == 0
    assert [one.name for one in folder.iterdir()] == ["scene.yaml"]
    assert not Path(f"{os.devnull}.parts").exists()
    assert not Path(f"{os.devnull}.json").exists()


@pytest.mark.whole
def test_two_outputs_may_be_one_device(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["simulate", "scene.yaml", "--duration", "10 ms", "--plot", "/dev/null", "--still", "/dev/null"]
    assert run(words) == 0, capsys.readouterr().err
    assert Path("/dev/null").is_char_device()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere every name is a text")
def test_a_scene_whose_name_is_no_text_is_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = os.fsdecode(b"b\xff.yaml")
    Path(name).write_text(AVERAGE, encoding="utf-8")
    assert run(["simulate", name, "--duration", "20 ms", "--no-jit", "--out", f"{name}.csv"]) == 0


def test_texts_that_belong_together_are_written_all_or_none(tmp_path: Path) -> None:
    (tmp_path / "b.h").mkdir()
    with pytest.raises(ApcError, match="E601"):
        write_texts({tmp_path / "a.c": "one", tmp_path / "b.h": "two"})
    assert [one.name for one in tmp_path.iterdir()] == ["b.h"]
    write_texts({tmp_path / "a.c": "one", tmp_path / "b.c": "two"})
    assert ((tmp_path / "a.c").read_text(), (tmp_path / "b.c").read_text()) == ("one", "two")
