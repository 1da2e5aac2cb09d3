"""An FMU: a scene or one peer of it as FMI 2.0 for co-simulation, an archive that runs without Python.

Takes: a `CScene`. Gives: `Unit`, `unit_of`, `write_fmu`; `compile_texts`.
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
import xml.etree.ElementTree as xml
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import write_file
from apc.distribution import program_version
from apc.exports.c_text import header, source
from apc.exports.scene_text import CScene, scene_source
from apc.result import Result
from apc.simulation.native import compiler

# What gcc and clang take; contracted products and sums would round differently from `simulate`.
OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden", "-shared")
PATIENCE = 600.0  # seconds; a scene's code takes a few
PLATFORMS = {"Linux": ("linux", ".so"), "Darwin": ("darwin", ".dylib"), "Windows": ("win", ".dll")}
DATE = (1980, 1, 1, 0, 0, 0)  # of every member of the archive: the first there is


@dataclass(frozen=True, slots=True, eq=False)
class Unit(Result):
    """An FMU: the scene it plays, of which `peer` if it is one, and its texts by their names.

    `step` and `duration` are what a simulator may take, in seconds.
    """

    system: CompiledSystem
    peer: str
    scene: CScene
    step: float
    duration: float
    texts: Mapping[str, str]
    shown_by: ClassVar[str] = "exports:unit"

    @property
    def description(self) -> str:
        """The model description."""
        return _description(self)


def unit_of(system: CompiledSystem, scene: CScene, *, peer: str = "") -> Unit:
    """Return the FMU of a scene, or of the peer of that name."""
    timings = {timing.name: timing.value for timing in system.timings}
    step = float(min(timings[clock.period] for clock in system.clocks))
    duration = system.experiment.duration
    texts: dict[str, str] = {}
    for code in scene.codes:
        texts[f"{code.identifier}.h"] = header(code)
        texts[f"{code.identifier}.c"] = source(code, f"{code.identifier}.h")
    main = _main(scene)
    guid = hashlib.sha256("\0".join((*texts.values(), main)).encode()).hexdigest()
    texts[f"{_identifier(scene)}.c"] = main.replace("GUID_OF_TEXTS", guid)
    return Unit(system, peer, scene, step, float(duration) if duration else 1.0, texts)


def _identifier(scene: CScene) -> str:
    return f"{scene.name}_fmu"


def _guid(unit: Unit) -> str:
    main = unit.texts[f"{_identifier(unit.scene)}.c"]
    return main.partition('#define GUID "')[2].partition('"')[0]


def _main(scene: CScene) -> str:
    """Return the text between the peers' and the simulator."""
    inputs = sum(variable.given for variable in scene.variables)
    numbers = [(k, one) for k, one in enumerate(scene.variables) if not one.flag]
    flags = [(k, one) for k, one in enumerate(scene.variables) if one.flag]
    accessors = ""
    for type_, what, listed in (("double", "real", numbers), ("int", "flag", flags)):
        cases = "".join(f"    case {k}: return &m->{one.member};\n" for k, one in listed)
        accessors += f"""\
static {type_} *{what}(model *m, unsigned which) {{
  (void)m;
  switch (which) {{
{cases}    default: return 0;
  }}
}}

"""
    states = "".join(f"    case {k}: return 1;\n" for k, one in numbers if one.moving or one.fixed)
    engine = Path(__file__).with_name("fmi2.c").read_text(encoding="utf-8")
    return f"""\
{scene_source(scene)}
{accessors}/* Whether it comes from outside: such numbers are the first. */
static int given(unsigned which) {{
  (void)which;
  return {f"which < {inputs}u" if inputs else "0"};
}}

/* Whether it is a state or a parameter, which can be set until the scene begins. */
static int moving(unsigned which) {{
  switch (which) {{
{states}    default: return 0;
  }}
}}

#define QUANTA {float(scene.quantum.denominator)!r}
#define SECONDS {float(scene.quantum.numerator)!r}
#define GUID "GUID_OF_TEXTS"

{engine}"""


def _description(unit: Unit) -> str:
    """Return modelDescription.xml."""
    scene, system = unit.scene, unit.system
    root = xml.parse(Path(__file__).with_name("fmu.xml")).getroot()
    part = {one.tag: one for one in root.iter()}
    root.set("modelName", f"{unit.peer} of {system.name}" if unit.peer else system.name)
    root.set("guid", _guid(unit))
    root.set("generationTool", f"apc {program_version()}")
    if system.about:
        root.set("description", system.about)
    part["CoSimulation"].set("modelIdentifier", _identifier(scene))
    part["DefaultExperiment"].set("stopTime", repr(unit.duration))
    part["DefaultExperiment"].set("stepSize", repr(unit.step))
    for one in sorted(unit.texts):
        if one.endswith(".c"):
            xml.SubElement(part["SourceFiles"], "File", name=one)
    for one in dict.fromkeys(own.unit for own in scene.variables if not own.flag):
        xml.SubElement(part["UnitDefinitions"], "Unit", name=one)
    for place, own in enumerate(scene.variables):
        causality = "input" if own.given else "parameter" if own.fixed else "output"
        row = xml.SubElement(part["ModelVariables"], "ScalarVariable", name=own.name, causality=causality)
        row.attrib |= {"valueReference": str(place), "variability": "fixed" if own.fixed else "discrete"}
        if own.flag:
            xml.SubElement(row, "Boolean", start="false")
        elif own.given or own.fixed:
            xml.SubElement(row, "Real", start=repr(own.start), unit=own.unit)
        else:
            start = {"start": repr(own.start)} if own.moving else dict[str, str]()
            row.attrib |= {"initial": "exact"} if own.moving else {}
            xml.SubElement(row, "Real", {"unit": own.unit} | start)
            for group in ("Outputs",) if own.moving else ("Outputs", "InitialUnknowns"):
                xml.SubElement(part[group], "Unknown", index=str(place + 1))
    xml.indent(root)
    return xml.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def compile_texts(texts: Mapping[str, str], options: Sequence[str], place: Place) -> bytes:
    """Return what a compiler makes of texts of C, by their file names; `place` is what is told of.

    Raises
    ------
    ApcError
        E962 there is no compiler, or it doesn't take them.
    """
    found = compiler()
    if found is None:
        what = "no C compiler answers to cc, gcc or clang, or to what the variable CC says"
        raise ApcError(
            Mistake("E962", place, what, hint="gcc or clang installed, or --to c, which needs none")
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for one, text in texts.items():
            (folder / one).write_text(text, encoding="utf-8")
        listed = [one for one in texts if one.endswith(".c")]
        command = [found[0], *options, *listed, "-o", "built", "-lm"]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise ApcError(Mistake("E962", place, f"{found[0]} can't be run: {error}")) from None
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["nothing"])[0][:200]
            what = f"{found[0]} doesn't compile it, and says: {said}"
            raise ApcError(Mistake("E962", place, what))
        return (folder / "built").read_bytes()


def write_fmu(path: Path, unit: Unit) -> None:
    """Write an FMU, whole or not at all. Raises ApcError (E601, E962)."""
    system, suffix = PLATFORMS.get(platform.system(), PLATFORMS["Linux"])
    library = compile_texts(unit.texts, OPTIONS, Place(str(path)))
    members = {"modelDescription.xml": unit.description.encode()}
    members |= {f"sources/{one}": text.encode() for one, text in unit.texts.items()}
    members[f"binaries/{system}64/{_identifier(unit.scene)}{suffix}"] = library

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for one, content in members.items():
                archive.writestr(zipfile.ZipInfo(one, DATE), content, zipfile.ZIP_DEFLATED)

    write_file(path, write)
