"""An FMU: a scene or one peer of it as FMI 2.0 for co-simulation, an archive that runs without Python.

Takes: a `CScene`. Gives: `FmuContent`, `unit_of`, `write_fmu`; `compile_texts`.
Guarantees: the archive holds a description, the sources and a library of this platform; the same scene gives
the same description and sources. An FMU's step is exact at the scene's instants; the time of a step is the
simulator's choice.
Does not: write the equations (see `c_text`, `scene_text`).
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
from apc.distribution import program_version
from apc.exports.c_text import header, source
from apc.exports.scene_text import CScene, shared
from apc.exports.texts import filled
from apc.result import Result
from apc.simulation.native import compiler

# What gcc and clang take; contracted products and sums would round differently from `simulate`.
OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden", "-shared")
PATIENCE = 600.0  # seconds; a scene's code takes a few
PLATFORMS = {"Linux": ("linux", ".so"), "Darwin": ("darwin", ".dylib"), "Windows": ("win", ".dll")}
PLACE_OF_GUID = "GUID_OF_TEXTS"
DATE = (1980, 1, 1, 0, 0, 0)  # of every member of the archive: the first there is


@dataclass(frozen=True, slots=True, eq=False)
class FmuContent(Result):
    """An FMU: the scene it plays, of which `peer` if it is one, and its texts by their names.

    `step` and `duration` are what a simulator may take, in seconds; `guid` is a digest of the texts.
    """

    system: Model
    peer: str
    scene: CScene
    step: float
    duration: float
    guid: str
    texts: Mapping[str, str]
    shown_by: ClassVar[str] = "exports_output:unit"

    @property
    def identifier(self) -> str:
        """What the FMU's library and main text are called."""
        return f"{self.scene.name}_fmu"

    @property
    def description(self) -> str:
        """The model description, modelDescription.xml."""
        name = f"{self.peer} of {self.system.name}" if self.peer else self.system.name
        fields = {"name": name, "about": self.system.about, "variables": self.scene.variables}
        return filled("fmu.xml", unit=self, version=program_version(), **fields)


def unit_of(system: Model, scene: CScene, *, peer: str = "") -> FmuContent:
    """Return the FMU of a scene, or of the peer of that name."""
    timings = {timing.name: timing.value for timing in system.timings}
    step = float(min(timings[clock.period] for clock in system.clocks))
    duration = system.experiment.duration
    texts: dict[str, str] = {}
    for code in scene.codes:
        texts[f"{code.identifier}.h"] = header(code)
        texts[f"{code.identifier}.c"] = source(code, f"{code.identifier}.h")
    main = filled(
        "fmu.c",
        inputs=sum(variable.given for variable in scene.variables),
        guid=PLACE_OF_GUID,
        **shared(scene),
    )
    guid = hashlib.sha256("\0".join((*texts.values(), main)).encode()).hexdigest()
    unit = FmuContent(system, peer, scene, step, float(duration) if duration else 1.0, guid, texts)
    texts[f"{unit.identifier}.c"] = main.replace(PLACE_OF_GUID, guid)
    return unit


def compile_texts(texts: Mapping[str, str], options: Sequence[str], place: SourceLocation) -> bytes:
    """Return what a compiler makes of texts of C, by their file names; `place` is what is told of.

    Raises
    ------
    ApcError
        E962 there is no compiler, or it doesn't take them.
    """
    pair = compiler()
    if pair is None:
        what = "no C compiler answers to cc, gcc or clang, or to what the variable CC says"
        raise ApcError(
            Diagnostic("E962", place, what, hint="gcc or clang installed, or --to c, which needs none")
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for item, text in texts.items():
            (folder / item).write_text(text, encoding="utf-8")
        listed = [text for text in texts if text.endswith(".c")]
        command = [pair[0], *options, *listed, "-o", "built", "-lm"]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise ApcError(Diagnostic("E962", place, f"{pair[0]} can't be run: {error}")) from None
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["nothing"])[0][:200]
            what = f"{pair[0]} doesn't compile it, and says: {said}"
            raise ApcError(Diagnostic("E962", place, what))
        return (folder / "built").read_bytes()


def write_fmu(path: Path, unit: FmuContent) -> None:
    """Write an FMU, whole or not at all. Raises ApcError (E601, E962)."""
    system, suffix = PLATFORMS.get(platform.system(), PLATFORMS["Linux"])
    library = compile_texts(unit.texts, OPTIONS, SourceLocation(str(path)))
    members = {"modelDescription.xml": unit.description.encode()}
    members |= {f"sources/{item}": text.encode() for item, text in unit.texts.items()}
    members[f"binaries/{system}64/{unit.identifier}{suffix}"] = library

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for text, content in members.items():
                archive.writestr(zipfile.ZipInfo(text, DATE), content, zipfile.ZIP_DEFLATED)

    write_file(path, write)
