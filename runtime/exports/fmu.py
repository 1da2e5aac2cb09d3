"""An FMU: a model or one peer of it as FMI 2.0 for co-simulation, an archive that runs without Python.

Takes: a `CTopology`. Gives: `FmuContent`, `unit_of`, `write_fmu`; `compile_texts`.
Guarantees: the archive holds a description, the sources and a library of this platform; the same model gives
the same description and sources. An FMU's step is exact at the model's instants; the time of a step is the
simulator's choice.
Does not: write the equations (see `c_text`, `topology_text`).
"""

from __future__ import annotations

import hashlib
import platform
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import write_file
from apc.exports.c_text import header, source
from apc.exports.texts import filled
from apc.exports.topology_text import CTopology, shared
from apc.result import Result
from apc.simulation.c_compiler import compiler
from apc.support.distribution import program_version

# Options of gcc and clang; contracted products and sums would round differently from `simulate`.
OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden", "-shared")
PATIENCE = 600.0  # seconds; a model's code takes a few
PLATFORMS = {"Linux": ("linux", ".so"), "Darwin": ("darwin", ".dylib"), "Windows": ("win", ".dll")}
OFFSET_OF_GUID = "GUID_OF_TEXTS"
DATE = (1980, 1, 1, 0, 0, 0)  # of every member of the archive: the earliest date of ZIP


@dataclass(frozen=True, slots=True, eq=False)
class FmuContent(Result):
    """The content of an FMU: its model, or `peer` if it contains one peer, and its texts by file name.

    `step` and `duration` are the proposed step size and duration in seconds; `guid` is a digest of the texts.
    """

    model: Model
    peer: str
    topology: CTopology
    step: float
    duration: float
    guid: str
    texts: Mapping[str, str]
    shown_by: ClassVar[str] = "exports_output:unit"

    @property
    def identifier(self) -> str:
        """The names of the FMU's library and main text."""
        return f"{self.topology.name}_fmu"

    @property
    def description(self) -> str:
        """The model description, modelDescription.xml."""
        name = f"{self.peer} of {self.model.name}" if self.peer else self.model.name
        fields = {"name": name, "description": self.model.description, "variables": self.topology.variables}
        return filled("fmu.xml", unit=self, version=program_version(), **fields)


def unit_of(model: Model, topology: CTopology, *, peer: str = "") -> FmuContent:
    """Return the content of the FMU of a model, or of the peer of that name."""
    timings = {timing.name: timing.value for timing in model.timings}
    step = float(min(timings[clock.period] for clock in model.clocks))
    duration = model.experiment.duration
    texts: dict[str, str] = {}
    for code in topology.codes:
        texts[f"{code.identifier}.h"] = header(code)
        texts[f"{code.identifier}.c"] = source(code, f"{code.identifier}.h")
    main = filled(
        "fmu.c",
        inputs=sum(variable.given for variable in topology.variables),
        guid=OFFSET_OF_GUID,
        **shared(topology),
    )
    guid = hashlib.sha256("\0".join((*texts.values(), main)).encode()).hexdigest()
    unit = FmuContent(model, peer, topology, step, float(duration) if duration else 1.0, guid, texts)
    texts[f"{unit.identifier}.c"] = main.replace(OFFSET_OF_GUID, guid)
    return unit


def compile_texts(texts: Mapping[str, str], options: Sequence[str], location: SourceLocation) -> bytes:
    """Return the compiled library of C texts, given by file name; `location` is that of error messages.

    Raises
    ------
    ApcError
        E962 there is no compiler, or compilation fails.
    """
    pair = compiler()
    if pair is None:
        message = "no C compiler found (cc, gcc, clang or the variable CC)"
        raise ApcError(Diagnostic("E962", location, message, advice="install gcc or clang, or use --to c"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for item, text in texts.items():
            (folder / item).write_text(text, encoding="utf-8")
        sources = [text for text in texts if text.endswith(".c")]
        command = [pair[0], *options, *sources, "-o", "built", "-lm"]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise ApcError(Diagnostic("E962", location, f"{pair[0]} can't be run: {error}")) from None
        if done.returncode:
            messages = (done.stderr.strip().splitlines() or ["nothing"])[0][:200]
            message = f"{pair[0]} failed to compile the code: {messages}"
            raise ApcError(Diagnostic("E962", location, message))
        return (folder / "built").read_bytes()


def write_fmu(path: Path, unit: FmuContent) -> None:
    """Write an FMU completely or not at all. Raises ApcError (E601, E962)."""
    system, suffix = PLATFORMS.get(platform.system(), PLATFORMS["Linux"])
    library = compile_texts(unit.texts, OPTIONS, SourceLocation(str(path)))
    members = {"modelDescription.xml": unit.description.encode()}
    members |= {f"sources/{item}": text.encode() for item, text in unit.texts.items()}
    members[f"binaries/{system}64/{unit.identifier}{suffix}"] = library

    def write(temporary: Path) -> None:
        """Write the archive to a temporary file."""
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for text, content in members.items():
                archive.writestr(zipfile.ZipInfo(text, DATE), content, zipfile.ZIP_DEFLATED)

    write_file(path, write)
