"""Runs inputs through the compiler and forged models through the program, under a watchdog.

Takes: inputs, forged models. Gives: `Failure`, `run_all`, `run_models`, `shrunk`.
Guarantees: one input can't bring the run down, whether it crashes, hangs or eats memory.
Does not: make inputs.

An input may compile, or be refused with `ApcError` whose mistakes each have a code, a sentence of one line
and a place that exists, in the order of the file, none twice. A forged model may be refused as damaged, or
what is asked of it answered or refused. Anything else is a failure, and is told.
"""

from __future__ import annotations

import importlib
import os
import random
import re
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

import apc
from apc.compiler import pipeline
from apc.compiler.components.library import Library
from apc.compiler.errors import ApcError, Mistake
from apc.compiler.language import unit_names
from apc.compiler.pipeline import run_stages
from tests.fuzz import arrays, models
from tests.fuzz.inputs import MODELS, PLAYED, SENTINEL, TOPOLOGY, Input, make_input

SECONDS = 5.0  # of processor time, the longest an input may take to compile
PLAYED_SECONDS = 10.0  # and to compile, check itself, be analysed and simulated
QUESTIONS = 60.0  # the same for all that is asked of a forged model
PATIENCE = 300.0  # seconds until a process that says nothing is taken to hang, on however busy a machine
MEMORY = 1 << 30  # bytes an input may ask for beyond what is in use
BATCH = 4000  # inputs a process runs before a fresh one takes over
LONGEST_SENTENCE = 2000
WHOLE_FILE = re.compile(
    r"E(10[1-8]|110|701|[89]\d\d)\Z"
)  # mistakes about a file or scene as a whole may have no line

# What no input may cause; events of Python's own audit hooks.
_FOREIGN = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect",
            "os.remove", "os.rename", "os.mkdir", "shutil.rmtree", "ctypes.dlopen", "exec",
            "compile")  # fmt: skip

_CYTHON = b"_getframe()"  # what Cython has compiled when it writes a traceback
# What `dataclasses` writes for a class of many objects, of its fields' names, and SymPy for products of some
# number of unknowns, and runs: nothing of a file is in it.
_METHODS = re.compile(
    rb"def __create_fn__\([\w, ]*\):\n def __(init|eq|hash|setattr|delattr|[lg][te])__\("
    rb"|def monomial_[a-z]+\((A, B|A, k|A, B, k)\):\n(    [\w (),:=+*<>-]+\n)+\Z"
)
_OWN_TEXT = re.compile(r'<code object <module> .*"<string>", line 1>')
_MODULE = re.compile(r'<code object <module> .*\.py", line 1>')  # what runs when a module is loaded


@dataclass(frozen=True, slots=True)
class Failure:
    """What went wrong: `key` is the same for failures of one cause, as far as can be told."""

    key: str
    told: str
    index: int
    given: Input


def run_all(
    count: int,
    seed: int,
    *,
    start: int = 0,
    sort: str | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> tuple[list[Failure], Counter[str], Counter[str]]:
    """Run inputs number `start` to `count` of a seed, all of one sort if one is given.

    Returns
    -------
    failures
        The first of each cause.
    often
        How often each came.
    outcomes
        How many inputs of each sort came to what.
    """
    _warm_up()
    failures: dict[str, Failure] = {}
    often: Counter[str] = Counter()
    outcomes: Counter[str] = Counter()
    following = start
    shown = time.monotonic()
    while following < count:
        for index, key, told in _worker(seed, following, min(count, following + BATCH), sort):
            following = index + 1
            fine = key in ("compiled", "refused")
            outcomes[f"{told}: {key}" if fine else f"{nth_input(seed, index, sort).sort}: FAILED"] += 1
            if not fine:
                often[key] += 1
                if key not in failures:
                    failures[key] = Failure(key, told, index, nth_input(seed, index, sort))
            if time.monotonic() - shown > 10:
                shown = time.monotonic()
                progress(f"{following} inputs, {len(failures)} different failures")
    return list(failures.values()), often, outcomes


def nth_input(seed: int, index: int, sort: str | None = None) -> Input:
    """Return one input of a run."""
    return make_input(random.Random(f"{seed}/{index}"), sort)


class _WarmLibrary(Library):
    """A library that has read the built-in components already, as long as no folder shadows one."""

    builtin = Library()

    def __init__(self, folders: tuple[Path, ...] = ()) -> None:
        super().__init__(folders)
        if not folders:
            self._components = dict(self.builtin._components)
            self._connectors = dict(self.builtin._connectors)


def _warm_up() -> None:
    """Load everything once, so that no input pays for it and processes share it."""
    for name in _WarmLibrary.builtin.component_names:
        _WarmLibrary.builtin.component(name)
    pipeline.Library = _WarmLibrary  # type: ignore[misc] # for the fuzzer's own processes
    # What is loaded when it is first needed, and compiles text then: for a hint, for a large scene.
    loaded = (
        "numpy.ma",
        "numpy.random",
        "difflib",
        "tempfile",
        "traceback",
        "scipy.linalg",
        "sympy.physics.units",
    )
    for module in loaded:
        importlib.import_module(module)
    unit_names._scaled("furlong")  # one of the rare units, which pint knows
    for scene in ("three-users-average", "finger", "users-table"):
        run_stages(MODELS / "scenes" / f"{scene}.yaml", until="compiled")
    before = Path.cwd()
    os.chdir(MODELS / "scenes")
    for scene in ("three-users-average", "experiment-average"):
        system = apc.compile(f"{scene}.yaml")
        apc.analyze(system)
        apc.simulate(system, duration="20 ms", jit=False)
    os.chdir(before)


def _worker(seed: int, start: int, stop: int, sort: str | None) -> Iterator[tuple[int, str, str]]:
    """Yield (index, outcome, text) of inputs run in a process of their own; ends early if that is killed.

    The text of an input that compiled or was refused is its sort.
    """

    def work(tell: Callable[[int, str, str], None]) -> None:
        for index in range(start, stop):
            given = nth_input(seed, index, sort)
            key, told = _judged(given)
            tell(index, key, told or given.sort)

    return _watched(work, start, stop)


def run_forged(what: str, count: int, seed: int) -> tuple[dict[str, tuple[int, str]], Counter[str]]:
    """Run forged files number 0 to `count` of a seed.

    Parameters
    ----------
    what
        One of `FORGERIES`.

    Returns
    -------
    failures
        Of each cause, the number of the first and what is told of it.
    outcomes
        How many files of each sort came to what.
    """
    warm_up, forge, ask = FORGERIES[what]
    warm_up()
    failures: dict[str, tuple[int, str]] = {}
    outcomes: Counter[str] = Counter()
    following = 0

    def work(tell: Callable[[int, str, str], None]) -> None:
        for index in range(following, count):
            sort, files = forge(f"{seed}/{index}")
            key, told = _traced(files, lambda: (ask(), ""), QUESTIONS)
            tell(index, key, told or sort)

    while following < count:
        for index, key, told in _watched(work, following, count):
            following = index + 1
            if key in ("answered", "refused"):
                outcomes[f"{told}: {key}"] += 1
            else:
                outcomes[f"{forge(f'{seed}/{index}')[0]}: FAILED"] += 1
                failures.setdefault(key, (index, told))
    return failures, outcomes


def _forge_model(seed: str) -> tuple[str, arrays.Files]:
    forged = models.forge(seed)
    return forged.sort, ((models.FILE, forged.content),)


def _warm_models() -> None:
    """Load everything once: what is loaded later looks as if a file had had it loaded."""
    with tempfile.TemporaryDirectory() as name:
        for origin, model in models.bases():
            path = Path(name) / models.FILE
            path.write_bytes(models.unsealed(msgspec.json.encode(origin), model))
            assert models.ask(path, everything=True) == "answered"


def _warm_arrays(files: arrays.Files, ask: Callable[[], str]) -> None:
    """Read what nobody changed."""
    assert _traced(files, lambda: (ask(), "")) == ("answered", "")


FORGERIES: dict[
    str, tuple[Callable[[], None], Callable[[str], tuple[str, arrays.Files]], Callable[[], str]]
] = {
    "models": (_warm_models, _forge_model, lambda: models.ask(Path(models.FILE))),
    "recordings": (
        lambda: _warm_arrays(arrays.recording(), arrays.ask_recording),
        arrays.forge_recording,
        arrays.ask_recording,
    ),
    "parts": (
        lambda: _warm_arrays(arrays.part(), arrays.ask_part),
        arrays.forge_part,
        arrays.ask_part,
    ),
}


def once(given: Input) -> tuple[str, str]:
    """Return the outcome and text of one input, run in a process of its own."""
    [(_, key, told)] = list(_watched(lambda tell: tell(0, *_judged(given)), 0, 1))
    return key, told


def _watched(
    work: Callable[[Callable[[int, str, str], None]], object], start: int, stop: int
) -> Iterator[tuple[int, str, str]]:
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        _become_worker(work, write)
    os.close(write)
    following, rest = start, b""
    killed = ""
    with os.fdopen(read, "rb", buffering=0) as stream:
        while following < stop:
            ready, _, _ = select.select([stream], [], [], PATIENCE)
            data = stream.read(1 << 16) if ready else b""
            if not data:
                killed = "" if ready else "takes for ever"
                break
            *lines, rest = (rest + data).split(b"\0")
            for line in lines:
                number, key, told = line.decode("utf-8", "replace").split("\x1f")
                yield int(number), key, told
                following = int(number) + 1
    if killed:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if following < stop:
        ended = (
            f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit {os.WEXITSTATUS(status)}"
        )
        yield following, killed or f"process ended by {ended}", ""


def _become_worker(work: Callable[[Callable[[int, str, str], None]], object], write: int) -> None:
    """Do the work and leave; never returns."""
    code = 1
    try:
        in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (in_use + MEMORY, in_use + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        sys.addaudithook(_listen)

        def tell(index: int, key: str, told: str) -> None:
            line = "\x1f".join((str(index), key, told.replace("\x1f", " ").replace("\0", " ")))
            data = line.encode("utf-8", "replace") + b"\0"
            while data:
                data = data[os.write(write, data) :]

        work(tell)
        code = 0
    finally:
        os._exit(code)


_foreign: list[str] = []
_listening = False
_of_methods = False  # what was compiled last


def _listen(event: str, arguments: tuple[object, ...]) -> None:
    """Note what no input may cause, and files opened to write."""
    global _of_methods
    if not _listening or arguments[:1] == (_CYTHON,):
        return
    if event == "compile":
        _of_methods = isinstance(arguments[0], bytes) and bool(_METHODS.match(arguments[0]))
    if _of_methods and (event == "compile" or (event == "exec" and _OWN_TEXT.search(str(arguments)))):
        return
    if (event in _FOREIGN and not (event == "exec" and _MODULE.search(str(arguments)))) or (
        event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+")
    ):
        _foreign.append(f"{event} {str(arguments)[:200]}")


def _judged(given: Input) -> tuple[str, str]:
    """Run one input in this process: "compiled", "refused", or the key and text of what is wrong."""

    def run() -> tuple[str, str]:
        global _listening
        try:
            run_stages(Path(TOPOLOGY), until="compiled")
            _listening = False
            if given.sort == PLAYED:
                _play()
        except ApcError as error:
            return _fault_of(error, dict(given.files)) or ("refused", "")
        return "compiled", ""

    return _traced(given.files, run, PLAYED_SECONDS if given.sort == PLAYED else SECONDS)


def _traced(
    files: Sequence[tuple[str, bytes]], run: Callable[[], tuple[str, str]], seconds: float = SECONDS
) -> tuple[str, str]:
    """Return what `run` gives in a folder of some files, or the key and text of what it does wrong."""
    global _listening
    with tempfile.TemporaryDirectory(prefix="apc-fuzz-", dir=_memory_folder()) as name:
        folder = Path(name)
        for file, data in files:
            (folder / file).parent.mkdir(exist_ok=True)
            (folder / file).write_bytes(data)
        before = Path.cwd()
        os.chdir(folder)
        _foreign.clear()
        started = time.process_time()
        signal.signal(signal.SIGPROF, _too_long)
        signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            _listening = True
            try:
                outcome = run()
            finally:
                _listening = False
                signal.setitimer(signal.ITIMER_PROF, 0)
                took = time.process_time() - started
        except BaseException as error:  # whatever it is, it is what we are looking for
            outcome = _key_of(error), "".join(traceback.format_exception(error, limit=-12))[-4000:]
        finally:
            os.chdir(before)
        if took > seconds and not outcome[0].startswith("takes"):
            outcome = f"takes more than {seconds:g} s", f"{took:.1f} s"
        if (folder / SENTINEL).exists() or _foreign:
            outcome = (
                f"does what it may not: {_foreign[0].split()[0] if _foreign else SENTINEL}",
                "\n".join(_foreign),
            )
        return outcome


def _play() -> None:
    """Compile, analyse and simulate a scene; ends the run of one that is refused with ApcError."""
    system = apc.compile(TOPOLOGY)
    apc.analyze(system)
    apc.simulate(system, duration="20 ms", jit=False)


def _memory_folder() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


class TooLongError(BaseException):
    """Raised by the alarm; no handler of `Exception` can swallow it."""


def _too_long(number: int, frame: object) -> None:
    raise TooLongError


def _key_of(error: BaseException) -> str:
    """Return the kind of an exception and the innermost line of ours."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if re.search("/(compiler|runtime)/", frame.filename)]
    where = f"{Path(ours[-1].filename).name}:{ours[-1].name}" if ours else "?"
    if isinstance(error, TooLongError):
        outer = next(
            (f"{Path(f.filename).name}:{f.name}" for f in ours if Path(f.filename).name != "pipeline.py"), ""
        )
        return f"takes too long in {outer}"
    return f"{type(error).__name__} in {where}:{ours[-1].lineno if ours else 0}"


# ---- what an ApcError must be ----


def _fault_of(error: ApcError, files: dict[str, bytes]) -> tuple[str, str] | None:
    """Return what is wrong with the mistakes of an error."""
    told = str(error)[:3000]
    mistakes = error.mistakes
    if len(set(mistakes)) < len(mistakes) or len({str(m) for m in mistakes}) < len(mistakes):
        return f"told twice: {_twice(mistakes)}", told
    texts = {name: re.split(rb"\r\n|\n|\r", data) for name, data in files.items()}
    for mistake in mistakes:
        fault = _fault_in(mistake, texts)
        if fault:
            return f"{fault}: {mistake.code} {_shape(mistake.sentence)}", told
    by_file: dict[str, list[Mistake]] = {}
    for mistake in mistakes:
        by_file.setdefault(mistake.place.file, []).append(mistake)
    for own in by_file.values():
        places = [(mistake.place.line, mistake.place.column) for mistake in own]
        if places != sorted(places):
            return f"not in the file's order: {mistakes[0].code}", told
    return None


def _twice(mistakes: tuple[Mistake, ...]) -> str:
    (text, _), *_ = Counter(f"{m.code} {_shape(m.sentence)}" for m in mistakes).most_common(1)
    return text


def _shape(sentence: str) -> str:
    """Return the first words of a sentence, its names taken out."""
    return " ".join(re.sub(r"[^a-z ,']+", "_", sentence).split()[:5])


def _fault_in(mistake: Mistake, texts: dict[str, list[bytes]]) -> str:
    sentence, place = mistake.sentence, mistake.place
    if not re.fullmatch(r"E\d{3}", mistake.code):
        return "no code"
    if len(sentence.strip(" .")) < 8:
        return "no sentence"
    if any(ord(c) < 32 for c in sentence):
        return "a sentence of several lines"
    if len(sentence) > LONGEST_SENTENCE:
        return "a sentence that doesn't end"
    if re.search(r"<[\w.]+ object at|Traceback|NoneType|\bFraction\(|Error\(", sentence):
        return "Python's own words"
    if not place.file:
        return "no file"
    if not place.line and not WHOLE_FILE.match(mistake.code):
        return "no line"
    lines = texts.get(place.file.removeprefix("./"))
    if not place.line or lines is None:
        return ""
    if place.line == len(lines) + 1 and place.column == 1:  # the end of the file
        return ""
    if place.line > len(lines):
        return "a line that isn't there"
    line = lines[place.line - 1]
    quoted = place.file.endswith(".csv") and b'"' in line  # a cell's column is counted without its quotes
    if not quoted and not 1 <= place.column <= len(line) + 2:
        return "a column that isn't there"
    return ""


# ---- shrinking ----


def shrunk(failure: Failure, *, seconds: float = 40.0) -> Input:
    """Return a smaller input that fails in the same way: pieces taken out as long as that goes."""
    deadline = time.monotonic() + seconds
    files = dict(failure.given.files)

    def fails(trial: dict[str, bytes]) -> bool:
        key, _ = once(Input(failure.given.sort, tuple(trial.items())))
        return key == failure.key

    if not fails(files):
        return failure.given  # it needs what ran before it
    for name in list(files):
        if name != TOPOLOGY and fails({k: v for k, v in files.items() if k != name}):
            del files[name]
    for name in list(files):
        for separator in (b"\n", b", ", b" ", b""):
            pieces = files[name].split(separator) if separator else [bytes([b]) for b in files[name]]
            size = max(1, len(pieces) // 2)
            while size and time.monotonic() < deadline and len(pieces) < 5000:
                at = 0
                while at < len(pieces) and time.monotonic() < deadline:
                    trial = pieces[:at] + pieces[at + size :]
                    if fails({**files, name: separator.join(trial)}):
                        pieces = trial
                    else:
                        at += size
                size //= 2
            files[name] = separator.join(pieces) if len(pieces) < 5000 else files[name]
    return Input(failure.given.sort, tuple(files.items()))
