"""Runs hostile inputs through the compiler and forged files through the program, under a watchdog.

Takes: inputs, forged files. Gives: `Kind`, `kind_of`, `Failure`, `run_all`.
Guarantees: one input can't bring the run down, whether it crashes, hangs or eats memory.
Does not: make inputs.

An input may compile, or be refused with `ApcError` whose mistakes each have a code, a sentence of one line
and a place that exists, in the order of the file, none twice. A forged file may be refused as damaged, or
what is asked of it answered or refused. Anything else is a failure, and is told.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

import apc
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.pipeline import run_stages
from tests.fuzz.inputs import MODELS, PLAYED, SENTINEL, TOPOLOGY, Input, make_input
from tests.fuzz.models import FORGERIES, Forgery

SECONDS = 5.0  # of processor time, the longest an input may take to compile
PLAYED_SECONDS = 10.0  # and to compile, check itself, be analysed and simulated
PATIENCE = 300.0  # seconds until a process that says nothing is taken to hang, on however busy a machine
MEMORY = 1 << 30  # bytes an input may ask for beyond what is in use
BATCH = 4000  # inputs a process runs before a fresh one takes over
LONGEST_SENTENCE = 2000
FINE = ("compiled", "refused", "answered")
WHOLE_FILE = re.compile(r"E(10[1-8]|110|219|701|[89]\d\d)\Z")  # these mistakes may have no line

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
    reported: str
    index: int
    given: Input


@dataclass(frozen=True, slots=True)
class Kind:
    """Inputs of a kind: what is loaded before them, how a seed makes one, and its outcome in words."""

    warm_up: Callable[[], None]
    make: Callable[[str], Input]
    judge: Callable[[Input], tuple[str, str]]
    memory: int = MEMORY


def run_all(
    kind: Kind, count: int, seed: int, *, start: int = 0, progress: Callable[[str], None] = lambda text: None
) -> tuple[list[Failure], Counter[str], Counter[str]]:
    """Run inputs number `start` to `count` of a seed.

    Returns
    -------
    failures
        The first of each cause.
    often
        How often each came.
    outcomes
        How many inputs of each sort came to what.
    """
    kind.warm_up()
    failures: dict[str, Failure] = {}
    often: Counter[str] = Counter()
    outcomes: Counter[str] = Counter()
    following, shown = start, time.monotonic()
    while following < count:
        stop = min(count, following + BATCH)

        def work(tell: Callable[[int, str, str], None], first: int = following, stop: int = stop) -> None:
            for index in range(first, stop):
                given = kind.make(f"{seed}/{index}")
                key, reported = kind.judge(given)
                tell(index, key, reported or given.sort)

        for index, key, reported in _watched(work, following, stop, kind.memory):
            following = index + 1
            if key in FINE:
                outcomes[f"{reported}: {key}"] += 1
            else:
                given = kind.make(f"{seed}/{index}")
                outcomes[f"{given.sort}: FAILED"] += 1
                often[key] += 1
                failures.setdefault(key, Failure(key, reported, index, given))
            if time.monotonic() - shown > 10:
                shown = time.monotonic()
                progress(f"{following} inputs, {len(failures)} different failures")
    return list(failures.values()), often, outcomes


def kind_of(what: str, sort: str | None = None) -> Kind:
    """Return inputs, of a sort if one is given, or the forged files of a name."""
    if what == "inputs":
        return Kind(_warm_up, lambda seed: make_input(random.Random(seed), sort), _decided)
    forgery = FORGERIES[what]
    return Kind(partial(_warm_files, forgery), forgery.make, partial(_requested, forgery), forgery.memory)


def _warm_files(forgery: Forgery) -> None:
    """Load everything once: what is loaded later looks as if a file had had it loaded."""
    for given in forgery.whole():
        assert _requested(forgery, given) == ("answered", ""), "nobody changed it"


def _requested(forgery: Forgery, given: Input) -> tuple[str, str]:
    return _traced(given, lambda: (forgery.ask(), ""), forgery.seconds)


def _warm_up() -> None:
    """Load everything once, so that no input pays for it and processes share it."""
    # What is loaded when it is first needed, and compiles text then: for a hint, for a large topology.
    late = "numpy.ma numpy.random difflib tempfile traceback scipy.linalg sympy.physics.units"
    for module in late.split():
        importlib.import_module(module)
    before = Path.cwd()
    os.chdir(MODELS / "topologies")
    for topology in ("three-users-average", "experiment-average", "finger", "users-table"):
        model = apc.compile(f"{topology}.yaml")
        apc.analyze(model)
        apc.simulate(model, duration="20 ms", jit=False)
    os.chdir(before)
    odd = MODELS.joinpath("topologies", "three-users-average.yaml").read_bytes()
    _decided(
        Input("rare", ((TOPOLOGY, odd.replace(b"0.1 kg", b"1 furlong")),))
    )  # a unit that is looked up late


def _watched(
    work: Callable[[Callable[[int, str, str], None]], object], start: int, stop: int, memory: int
) -> Iterator[tuple[int, str, str]]:
    """Yield (index, outcome, text) of inputs run in a process of their own; ends early if that is killed.

    The text of an input that did nothing wrong is its sort.
    """
    context = multiprocessing.get_context("fork")
    received, tell = context.Pipe(duplex=False)
    child = context.Process(target=_become_worker, args=(work, tell, memory))
    child.start()
    tell.close()
    following = start
    try:
        while following < stop and received.poll(PATIENCE):
            index, key, reported = received.recv()
            yield index, key, reported
            following = index + 1
        silent = following < stop
    except EOFError:
        silent = False
    if silent:
        child.kill()
    child.join()
    if following < stop:
        yield following, "takes for ever" if silent else f"process ended with code {child.exitcode}", ""


def _become_worker(
    work: Callable[[Callable[[int, str, str], None]], object], pipe: Connection, memory: int
) -> None:
    """Do the work, with little memory, no output and what it causes noted."""
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (in_use + memory, in_use + memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    sys.addaudithook(_listen)
    work(lambda index, key, reported: pipe.send((index, key, reported)))


_foreign: list[str] = []
_listening = False
_of_methods = False  # what was compiled last


def _listen(event: str, arguments: tuple[object, ...]) -> None:
    """Note what no input may cause, and files opened to write."""
    global _of_methods
    # A tree of what NumPy reads as a literal, the head of an array, is parsed and never run.
    if not _listening or arguments[:1] == (_CYTHON,) or (event, *arguments[1:]) == ("compile", "<unknown>"):
        return
    if event == "compile":
        _of_methods = isinstance(arguments[0], bytes) and bool(_METHODS.match(arguments[0]))
    if _of_methods and (event == "compile" or (event == "exec" and _OWN_TEXT.search(str(arguments)))):
        return
    if (event in _FOREIGN and not (event == "exec" and _MODULE.search(str(arguments)))) or (
        event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+")
    ):
        _foreign.append(f"{event} {str(arguments)[:200]}")


def _decided(given: Input) -> tuple[str, str]:
    """Run one input in this process: "compiled", "refused", or the key and text of what is wrong."""

    def run() -> tuple[str, str]:
        global _listening
        try:
            run_stages(Path(TOPOLOGY), until="compiled")
            _listening = False
            if given.sort == PLAYED:
                model = apc.compile(TOPOLOGY)
                apc.analyze(model)
                apc.simulate(model, duration="20 ms", jit=False)
        except ApcError as error:
            return _fault_of(error, dict(given.files)) or ("refused", "")
        return "compiled", ""

    return _traced(given, run, PLAYED_SECONDS if given.sort == PLAYED else SECONDS)


def _traced(given: Input, run: Callable[[], tuple[str, str]], seconds: float) -> tuple[str, str]:
    """Return what `run` gives in a folder of an input's files, or the key and text of what it does wrong."""
    global _listening
    with tempfile.TemporaryDirectory(prefix="apc-fuzz-", dir=_memory_folder()) as name:
        folder = Path(name)
        for file, data in given.files:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
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
    reported = str(error)[:3000]
    mistakes = error.mistakes
    if len({str(one) for one in mistakes}) < len(mistakes):
        return f"told twice: {mistakes[0].code}", reported
    texts = {name: re.split(rb"\r\n|\n|\r", data) for name, data in files.items()}
    for mistake in mistakes:
        fault = _fault_in(mistake, texts)
        if fault:
            return f"{fault}: {mistake.code} {_shape(mistake.sentence)}", reported
    for name in {one.location.file for one in mistakes}:
        places = [(one.location.line, one.location.column) for one in mistakes if one.location.file == name]
        if places != sorted(places):
            return f"not in the file's order: {mistakes[0].code}", reported
    return None


def _shape(sentence: str) -> str:
    """Return the first words of a sentence, its names taken out."""
    return " ".join(re.sub(r"[^a-z ,']+", "_", sentence).split()[:5])


def _fault_in(mistake: Diagnostic, texts: dict[str, list[bytes]]) -> str:
    sentence, place = mistake.sentence, mistake.location
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
