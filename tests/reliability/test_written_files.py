"""What is no bounded file is not read, and what is written is whole and replaces nothing but a file."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import pytest

import apc
from apc.__main__ import run
from apc.cli.commands import apc as group
from apc.compiler import files
from apc.compiler.errors import ApcError
from apc.compiler.files import RefusedError, begin_file, finish_file, read_file, write_file, write_texts
from tests.commands import Cli, folder, write
from tests.topologies import AVERAGE, messages_of, replaced

FIFO = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
OUT = Path("r.csv")


@pytest.fixture(autouse=True)
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def fill(text: str) -> Callable[[Path], object]:
    return lambda temporary: temporary.write_text(text, encoding="utf-8")


def test_a_file_is_read_up_to_its_limit_and_nothing_is_opened_that_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write("a", "x" * 100)
    for name, target in (("link", "a"), ("zero", "/dev/zero"), ("cpu", "/proc/cpuinfo")):
        Path(name).symlink_to(target)
    os.mkfifo("pipe")
    assert read_file(Path("link"), 100) == b"x" * 100
    with pytest.raises(RefusedError, match="is larger than the limit of 99 bytes"):
        read_file(Path("link"), 99)
    monkeypatch.setattr(files, "_without_waiting", None)  # opening anything would fail otherwise
    for name, words in (
        ("pipe", "is a device, pipe or socket"),
        ("zero", "is a device, pipe or socket"),
        ("cpu", "is a file of the system's kernel"),
        ("", "is a folder"),
        ("none", "does not exist"),
        ("n" * 300, "File name too long"),
    ):
        with pytest.raises(RefusedError, match=words):
            read_file(Path(name), 100)


# ---- one file ----


def test_a_file_keeps_its_mode_and_a_new_one_has_that_of_the_mask() -> None:
    before = os.umask(0o027)
    try:
        write_file(OUT, fill("one"))
        assert stat.S_IMODE(OUT.stat().st_mode) == 0o640
        OUT.chmod(0o604)
        write_file(OUT, fill("two"))
    finally:
        os.umask(before)
    assert (stat.S_IMODE(OUT.stat().st_mode), OUT.read_text(), folder()) == (0o604, "two", ["r.csv"])


def test_a_link_stays_and_its_file_is_written() -> None:
    Path("there").mkdir()
    OUT.symlink_to("there/real.csv")
    write_file(OUT, fill("new"))
    assert OUT.is_symlink()
    assert [(one.name, one.read_text()) for one in Path("there").iterdir()] == [("real.csv", "new")]


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_of_a_failure_nothing_is_seen(fault: BaseException) -> None:
    write("r.csv", "before")

    def fail(temporary: Path) -> None:
        temporary.write_text("half", encoding="utf-8")
        raise fault

    with pytest.raises((ApcError, KeyboardInterrupt)) as raised:
        write_file(OUT, fail)
    assert str(raised.value) in ("r.csv: E601 can't be written: No space left on device.", "")
    assert (OUT.read_text(), folder()) == ("before", ["r.csv"])


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
def test_where_nothing_can_be_written_is_told(name: str, why: str) -> None:
    Path("round").symlink_to("round")
    (message,) = messages_of(write_file, Path(name), fill(""))
    assert f": E601 can't be written: {why}" in message


def test_texts_that_belong_together_are_written_all_or_none() -> None:
    Path("b.h").mkdir()
    with pytest.raises(ApcError, match="E601"):
        write_texts({Path("a.c"): "one", Path("b.h"): "two"})
    assert folder() == ["b.h"]
    write_texts({Path("a.c"): "one", Path("b.c"): "two"})
    assert (Path("a.c").read_text(), Path("b.c").read_text()) == ("one", "two")


# ---- what is no file ----


@FIFO
def test_a_pipe_is_written_to_and_stays_a_pipe() -> None:
    os.mkfifo(OUT)
    read: list[bytes] = []
    other = threading.Thread(target=lambda: read.append(OUT.read_bytes()))
    other.start()
    write_file(OUT, fill("through"))
    other.join()
    assert (read, stat.S_ISFIFO(OUT.stat().st_mode), folder()) == ([b"through"], True, ["r.csv"])
    there, here = os.pipe()
    Path("link.csv").symlink_to(f"/dev/fd/{here}")  # what `--out >(gzip)` leads to
    write_file(Path("link.csv"), fill("through"))
    os.close(here)
    with os.fdopen(there, "rb") as stream:
        assert stream.read() == b"through"


def test_a_device_is_written_to_and_stays_a_device() -> None:
    OUT.symlink_to(os.devnull)
    null = Path(os.devnull)
    before = null.stat()
    write_file(OUT, fill("gone"))
    temporary = begin_file(null)
    assert temporary.name.parent != null.parent, "nothing is made among the devices"
    finish_file(temporary, null)
    assert not temporary.name.exists()
    assert (before.st_ino, before.st_mode) == (null.stat().st_ino, null.stat().st_mode)
    assert OUT.is_symlink()


def test_standard_output_is_written_to_whatever_it_is_and_goes_on(capfd: pytest.CaptureFixture[str]) -> None:
    write("r.csv", "kept\n")
    before = os.dup(1)
    with OUT.open("ab") as stream:  # as `>> r.csv` does
        os.dup2(stream.fileno(), 1)
    try:
        for path in (Path("/dev/stdout"), OUT):
            write_file(path, fill("rows\n"))
        assert files.partial_name(OUT) == OUT
        os.write(1, b"more\n")
    finally:
        os.dup2(before, 1)
        os.close(before)
    assert (OUT.read_text(), folder()) == ("kept\nrows\nrows\nmore\n", ["r.csv"])
    assert capfd.readouterr() == ("", "")


# ---- what others write ----


def test_what_others_are_writing_stays() -> None:
    first, second = begin_file(OUT), begin_file(OUT)
    first.path.write_text("first", encoding="utf-8")
    write_file(OUT, fill("third"))
    second.path.write_text("second", encoding="utf-8")
    for temporary, text in ((first, "first"), (second, "second")):
        finish_file(temporary, OUT)
        assert OUT.read_text() == text
    assert folder() == ["r.csv"]


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="files have no names by descriptor here")
@pytest.mark.parametrize("when", ["before it is written", "before it is finished"])
@pytest.mark.parametrize("existing", [True, False])
def test_a_link_in_place_of_the_temporary_file_changes_nothing_else(when: str, existing: bool) -> None:
    """Whoever may write in the folder puts a link to a private file where the temporary file was."""
    private = Path("private")
    private.write_text("secret", encoding="utf-8")
    private.chmod(0o600)
    if existing:
        OUT.write_text("old", encoding="utf-8")
        OUT.chmod(0o666)

    def attack(temporary: Path) -> None:
        if when == "before it is finished":
            temporary.write_text("new", encoding="utf-8")
        (placed,) = [name for name in Path().iterdir() if name.name.endswith(".unfinished")]
        placed.unlink()
        placed.symlink_to(private.absolute())
        if when == "before it is written":
            temporary.write_text("new", encoding="utf-8")

    with pytest.raises(ApcError, match="another program has replaced"):
        write_file(OUT, attack)
    assert private.read_text() == "secret"
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert not OUT.is_symlink()
    assert (OUT.read_text() == "old") if existing else not OUT.exists()


ATTACK = """
import os, sys, time
os.setgid({user}); os.setuid({user}); os.chdir(sys.argv[1])
print("ready", flush=True)
while True:
    for name in os.listdir("."):
        if name.endswith(".unfinished"):
            try:
                os.rename(name, "taken-" + name)
                os.symlink("/" + sys.argv[2].lstrip("/"), name)
            except OSError:
                pass
"""


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="another user is needed")
def test_another_user_of_a_shared_folder_changes_no_file_of_the_writer(tmp_path: Path) -> None:
    private = tmp_path / "private"
    private.write_text("secret", encoding="utf-8")
    private.chmod(0o600)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        code = ATTACK.format(user=65534)
        words = [sys.executable, "-c", code, folder, str(private)]
        attacker = subprocess.Popen(words, stdout=subprocess.PIPE)
        try:
            assert attacker.stdout is not None
            assert attacker.stdout.readline() == b"ready\n"
            out = Path(folder, "out.csv")
            for number in range(300):
                try:
                    write_file(out, fill(f"{number}\n" * 1000))
                except ApcError as error:
                    expected = ("has replaced", "No such file", "a link of another user")
                    assert any(words in str(error) for words in expected)
                else:
                    assert not out.is_symlink()
                    assert out.read_text() == f"{number}\n" * 1000
                assert private.read_text() == "secret"
                assert stat.S_IMODE(private.stat().st_mode) == 0o600
        finally:
            attacker.kill()
            attacker.wait()


@pytest.mark.whole
def test_of_many_writers_at_once_each_writes_it_whole() -> None:
    texts = {str(number) * 10_000 for number in range(8)}

    def write_often(text: str) -> None:
        for _ in range(20):
            write_file(OUT, fill(text))
            assert OUT.read_text() in texts

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write_often, texts))
    assert folder() == ["r.csv"]


# ---- through the command line ----

TABLE = "device.mass [kg]\n0.1\n0.2\n"
WITH_TABLE = replaced(AVERAGE, ("{count: 3}", "{table: users.csv}"))


@pytest.fixture
def topology(cli: Cli) -> Cli:
    write("topology.yaml", AVERAGE)
    return cli


@FIFO
def test_a_pipe_as_a_model_or_as_a_table_is_not_waited_for(topology: Cli) -> None:
    os.mkfifo("topology.apc")
    assert topology("analyze topology.yaml").code == 0
    assert "E602 is a device, pipe or socket, not a compiled model." in topology("analyze topology.apc").err
    os.mkfifo("users.csv")
    write("topology.yaml", WITH_TABLE)
    assert "E701 the table users.csv is a device, pipe or socket." in topology("check").err


@FIFO
def test_a_model_is_never_compiled_into_what_is_none(topology: Cli) -> None:
    """Whoever packed a folder may have put anything under the model's name."""
    model = Path("topology.apc")
    write("own.txt", "mine")
    os.mkfifo("pipe")
    link, special = (
        f"topology.apc: E601 can't be written: it is {what}. Try: rm topology.apc\n"
        for what in ("a link to a file of another kind", "a device, pipe or socket")
    )
    for target, message in (("own.txt", link), ("new.txt", link), ("pipe", special), ("/dev/zero", special)):
        model.symlink_to(target)
        assert topology("compile topology.yaml") == (1, "", message)
        model.unlink()
    os.mkfifo(model)
    assert topology("compile topology.yaml") == (1, "", special)
    model.unlink()
    assert Path("own.txt").read_text() == "mine" and not Path("new.txt").exists()
    model.symlink_to("other.apc")
    assert topology("compile topology.yaml").code == 0
    assert model.is_symlink() and Path("other.apc").is_file()


@pytest.mark.parametrize(
    ("library", "message"),
    [
        ("/proc/self", "E214 the library folder /proc/self is a file of the system's kernel."),
        ("/", "E214 the library folder / holds more than 3 files and folders. Try: library: ./parts"),
        ("deep", "E214 the library folder deep is more than 2 folders deep"),
    ],
)
def test_a_folder_without_end_is_no_library(
    topology: Cli, monkeypatch: pytest.MonkeyPatch, library: str, message: str
) -> None:
    Path("deep/a/b/c").mkdir(parents=True)
    write("topology.yaml", f"library: {library}\n{AVERAGE}")
    monkeypatch.setattr(files, "MOST_ENTRIES", 9 if library == "deep" else 3)
    monkeypatch.setattr(files, "MOST_DEPTH", 2)
    assert message in topology("check topology.yaml").err


SECRET = "root:$6$abc:19000:0:99999:7:::"


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "text",
    [
        f"{SECRET}\ndaemon:*:19000:0:99999:7:::\n",
        f"ghp_{'S' * 30}\n",
        f"ghp_S\n{SECRET}\n",
        f"[{SECRET}]\nuser = {SECRET}\n",
        f"KEY={SECRET},1\n2\n",
        '"unclosed' + "S" * 200_000,
        f"token: [{SECRET}\nroot: {{\n",
    ],
)
def test_a_file_about_something_else_is_told_without_its_text(topology: Cli, text: str) -> None:
    Path("parts").mkdir()
    for name, changed in (
        ("users.csv", WITH_TABLE),
        ("users.csv", replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, trace: users.csv}"))),
        ("parts/config.yaml", f"library: ./parts\n{AVERAGE}"),
    ):
        write(name, text)
        write("topology.yaml", changed)
        ran = topology("check")
        requested = "E70" if name == "users.csv" else "E219" if "token" in text else ""
        assert requested in ran.err
        assert not any(word in ran.err for word in ("root", "SS", "ghp"))


# Every option that names a file to write, with what else its command wants.
SHORT = "topology.yaml --duration 40ms"
WRITING = {
    ("analyze", "--plot"): ("topology.yaml", "new.svg"),
    ("bench", "--plot"): ("topology.yaml", "new.svg"),
    ("compare", "--out"): ("topology.yaml", "new.json"),
    ("critical", "--plot"): ("contact.stiffness topology.yaml", "new.svg"),
    ("export", "--out"): ("topology.yaml", "new.npz"),
    ("fit", "--write"): ("delays.csv topology.yaml --free contact.stiffness=1N/m:9N/m", "a.yaml"),
    ("fit", "--plot"): ("delays.csv topology.yaml --free contact.stiffness=1N/m:9N/m", "new.svg"),
    ("transparency", "--out"): ("topology.yaml", "new.csv"),
    ("network", "--out"): ("delays.csv", "new.csv"),
    ("new", "--out"): ("--list", "new.html"),
    ("region", "--out"): (
        "topology.yaml --x contact.stiffness=1N/m:2N/m --y coordination.stiffness=1N/m:2N/m",
        "new.csv",
    ),
    ("report", "--out"): ("topology.yaml", "new.html"),
    ("schema", "--out"): ("", "new.json"),
    ("show", "--out"): ("topology.yaml", "new.txt"),
    ("simulate", "--out"): (SHORT, "new.csv"),
    ("simulate", "--plot"): (SHORT, "new.svg"),
    ("simulate", "--snapshot"): (SHORT, "new.svg"),
    ("sweep", "--out"): ("topology.yaml --over contact.stiffness=1N/m:2N/m:2 --jobs 1", "new.csv"),
    ("tune", "--write"): (
        "topology.yaml --free contact.stiffness=1N/m:9N/m --maximize contact.stiffness",
        "a.yaml",
    ),
}
# A folder, which has a test of its own; read and not written; a picture whose command takes half a minute.
OTHERS = {("run", "--out"), ("run", "--device"), ("run", "--secret-file"), ("bench", "--hard"),
          ("report", "--check"), ("tune", "--plot"), ("library", "--folder")}  # fmt: skip


def test_every_option_that_names_a_file_to_write_is_known_here() -> None:
    context = click.Context(group)
    options = {
        (name, option.opts[0])
        for name in group.list_commands(context)
        for option in group.get_command(context, name).params  # type: ignore[union-attr] # it is listed
        if isinstance(option.type, click.Path)
    }
    assert options == {*WRITING, *OTHERS}


INPUTS = ("topology.yaml", "users.csv", "topology.apc", "delays.csv")  # a recording last


@pytest.fixture
def inputs(topology: Cli) -> Cli:
    """Run commands where there are a topology, its table and compiled model, and a recording."""
    write("users.csv", TABLE)
    write("topology.yaml", WITH_TABLE)
    write("delays.csv", "delay [ms]\n1\n2\nlost\n3\n")
    assert topology("compile topology.yaml").code == 0
    return topology


@pytest.mark.few(10)
@pytest.mark.parametrize("command", WRITING)
def test_a_link_to_what_a_command_reads_is_refused_and_a_file_that_is_read_only_stays(
    inputs: Cli, command: tuple[str, str]
) -> None:
    before = [Path(one).read_bytes() for one in INPUTS]
    words, name = WRITING[command]
    line, target = f"{command[0]} {words} {command[1]} {name}", Path(name)
    for read in {"network": INPUTS[3:], "schema": (), "new": ()}.get(command[0], INPUTS[:3]):
        for link in (target.symlink_to, target.hardlink_to):
            link(read)
            assert inputs(line).err.startswith(f"{target}: E616 --")
            target.unlink()
    assert [Path(one).read_bytes() for one in INPUTS] == before
    write(name, "mine")
    target.chmod(0o444)
    assert inputs(line) == (1, "", f"{target}: E601 can't be written: it is read-only.\n")
    assert target.read_text() == "mine"
    assert not list(Path().glob(".*"))


@pytest.mark.parametrize(
    ("line", "alongside"),
    [
        ("export topology.yaml --peer user[1] --out new.c", "new.h"),
        ("export topology.yaml --peer user[1] --out new.c", "new_test.c"),
        (f"simulate {SHORT} --out new.csv", "new.csv.json"),
    ],
)
def test_beside_what_is_asked_for_nothing_that_is_read_is_replaced(
    inputs: Cli, line: str, alongside: str
) -> None:
    Path(alongside).symlink_to("topology.apc")
    ran = inputs(line)
    assert ran.code == 1 and f"{alongside}: E616 --out would replace an input file" in ran.err
    assert "E973 contains the topology of this run" in inputs(f"run {SHORT} --out .").err


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "sweep topology.yaml --over contact.stiffness=1N/m:2N/m:2 --out users.csv",
            "users.csv: E616 --out would replace an input file. Try: --out users-result.csv",
        ),
        (
            "show topology.txt --out topology.txt",
            "topology.txt: E616 --out would replace an input file. Try: --out topology-result.txt",
        ),
        (
            "simulate topology.yaml --duration 1s --plot a.png --snapshot ./a.png",
            "a.png: E616 same file for --plot and --snapshot. Try: --snapshot a-result.png",
        ),
    ],
)
def test_what_a_command_reads_it_never_replaces(inputs: Cli, line: str, message: str) -> None:
    write("topology.txt", AVERAGE)
    assert inputs(line) == (1, "", f"{message}\n")
    assert (Path("users.csv").read_text(), Path("topology.txt").read_text()) == (TABLE, AVERAGE)
    over = {"contact.stiffness": "1 N/m:2 N/m:2"}
    assert messages_of(lambda: apc.sweep("topology.yaml", over, out="users.csv")) == [
        'users.csv: E616 out would replace an input file. Try: out="users-result.csv"'
    ]


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("line", "start"),
    [
        ("sweep --over contact.stiffness=1N/m:2N/m:2 --jobs 1", "contact.stiffness [N/m],verdict"),
        ("simulate --duration 10ms --no-jit", "time [s],"),
        ("region --x contact.stiffness=0N/m:9N/m --y coordination.stiffness=0N/m:9N/m", "panel,topology,"),
        ("show", "three-users-average"),
        ("schema", "{"),
    ],
)
def test_a_device_takes_the_text_of_a_command_and_its_words_stand_beside(
    capfd: pytest.CaptureFixture[str], line: str, start: str
) -> None:
    write("topology.yaml", AVERAGE)
    assert run([*line.split(), "--out", "/dev/stdout"]) == 0
    out, err = capfd.readouterr()
    assert out.startswith(start)
    assert "/dev/stdout" in err and "/dev/stdout" not in out
    assert run([*line.split(), "--out", os.devnull]) == 0
    assert folder() == ["topology.yaml"]
    assert not Path(f"{os.devnull}.parts").exists() and not Path(f"{os.devnull}.json").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere every name is a text")
def test_a_topology_whose_name_is_no_text_is_simulated(cli: Cli) -> None:
    name = os.fsdecode(b"b\xff.yaml")
    write(name, AVERAGE)
    assert cli("simulate --duration 20ms --no-jit", name, "--out", f"{name}.csv").code == 0
