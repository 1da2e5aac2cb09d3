"""Each code a user can be told means one thing, and is told by those rooms that know of it."""

from __future__ import annotations

import ast
import re

from tests.topologies import ROOT

# A code, the rooms that tell it, and what it means.
CATALOGUE = """\
E101 compiler/source: a file does not exist
E102 compiler/source: a folder stands where a YAML file is due
E103 compiler/source: a YAML file may not be read
E104 compiler/source: what is named is no regular file
E105 compiler/source: a YAML file has too many bytes
E106 compiler/source: a YAML file is not UTF-8
E107 compiler/source: a YAML file has characters that can't be seen
E108 compiler/source: a YAML file is empty
E109 compiler/source: a text is not YAML
E110 compiler/source: a YAML file has several documents
E111 compiler/source: a key stands twice
E112 compiler/source: a key is no name
E113 compiler/source: a YAML tag is not part of the language, or does not fit its value
E114 compiler/source: an alias leads nowhere, or into itself
E115 compiler/source: a YAML file is nested too deep
E116 compiler/source: the merge key is not part of the language
E117 compiler/source: a YAML file has too many nodes
E201 compiler/components compiler/scene: something due is left out
E202 compiler/source: a key is not known where it stands
E203 compiler/components compiler/scene compiler/source: a value has another form than is due
E204 compiler/components compiler/language runtime/regions: a quantity has another unit than is due
E205 compiler/components compiler/scene compiler/source: a name is taken, or a word of the language
E206 compiler/components compiler/language compiler/scene compiler/view: a name names nothing that is there
E207 compiler/language compiler/scene runtime/cli: a number is out of its bounds
E208 compiler/components compiler/scene: a number of peers or parts, or of numbers for them, does not fit
E209 compiler/language: parameters depend on one another in a circle
E210 compiler/components compiler/equations compiler/scene: a connector is joined to what it can't be
E211 compiler/equations compiler/scene: a parameter can't have a value of its own there
E212 compiler/components: components contain or extend each other
E213 compiler/scene: an edge of a graph joins nothing it can join
E214 compiler/scene: a library folder can't be used
E215 compiler/functions: those at a link do not all send what is heard
E216 compiler/components compiler/scene: a peer has too many parts, or too deep in one another
E217 compiler/functions: weights can't be told apart from their sums as doubles
E218 compiler/components: a component is defined twice
E219 compiler/components: a file of a library defines nothing
E221 compiler/language: a text is no quantity
E222 compiler/language: a text is no unit
E223 compiler/language: a unit is not known
E224 compiler/language: a unit is no multiple of an SI unit
E225 compiler/language: a unit's exponent or scale is too large
E226 compiler/language: a quantity is too large for a number
E261 compiler/scene: a number is no probability
E262 compiler/scene: words about a link's packets contradict or lack one another
E303 compiler/components: an equation names what is not there
E321 compiler/language: a character can't stand in an expression
E322 compiler/language: an expression's form is wrong
E323 compiler/language: a number in an expression is written wrong
E324 compiler/language: a name in an expression is written wrong
E325 compiler/language: a function is not known, or takes another number of arguments
E326 compiler/language: an exponent is none that may stand there
E327 compiler/language: a number stands where a condition is due, or the other way round
E328 compiler/language: an expression is too long or nested too deep
E329 compiler/language: an equation has not just one =
E330 compiler/language: a name has no value in an expression of numbers
E331 compiler compiler/language runtime/frame: an expression has no finite value
E332 compiler/language: a parameter would follow what changes
E401 compiler/language: the sides of an equation differ in unit
E402 compiler/language: the terms of a sum differ in unit
E403 compiler/language: a quantity with a unit stands where a plain number is due
E404 compiler/language: what is compared or chosen between differs in unit
E405 compiler/language: a time is due where something of another unit stands
E406 compiler/language: vectors, or a vector and a number, are not of one size
E407 compiler/language: a vector stands where a number is due, or the reverse
E408 compiler/components: an index names no entry of a vector
E501 compiler/components: a component has not as many equations as unknowns
E502 compiler/equations: equations contradict or repeat one another
E503 compiler/equations: variables depend on one another in a loop that can't be solved
E504 compiler/equations: a part that samples or hears does not name one clock or link
E505 compiler/components compiler/equations: discrete and continuous values are mixed
E506 compiler/components compiler/equations: values of others and one's own are mixed
E507 compiler/equations: a memory has no start value
E508 compiler/equations: a derivative is needed of what has none
E509 compiler/equations: what rigid joints hold can't be determined
E510 compiler/equations: a state has no start value
E511 compiler/equations: equations that depend on one another leave their unknowns open
E512 compiler/equations: a constant is no number
E513 compiler/functions: what has a limit is computed at ticks
E601 compiler runtime: a file can't be written
E602 compiler: a compiled model can't be read
E603 compiler: a compiled model is of another format version
E604 compiler: a compiled model is damaged
E605 runtime: a compiled model is older than its texts
E610 runtime: a folder, or a list, has no scene
E611 runtime: a folder has several scenes
E612 runtime/cli: a new scene's name is none
E613 runtime/cli: a new scene's file exists
E614 runtime/cli: a compiled model is to be compiled
E615 runtime: a compiled model is to be shown
E616 runtime: a file to write is one that is read, or written already
E617 runtime: two topologies would be compiled to one file
E621 runtime/frame: a setting is not NAME=VALUE
E622 runtime/frame: a scene has no such parameter
E623 runtime/frame: the number of all peers follows from those of the groups; there it doesn't vary
E624 runtime/frame runtime/sweeps: a set value is out of its parameter's bounds
E625 runtime/frame runtime/sweeps: a set time is out of its bounds
E626 compiler: a number of peers can't be
E701 compiler/language: a table can't be read
E702 compiler/language compiler/scene: a table's headings or columns are not those due
E703 compiler/language: a cell or row of a table is wrong
E801 compiler/functions runtime/frame: an operator runs over nobody
E802 runtime/frame: the weights of a mean add up to nothing
E803 runtime/eigen: an operator over equal peers has no linearization
E804 runtime/analysis runtime/eigen runtime/exports runtime/large runtime/vary: too large, or not linear
E805 runtime/frame: a frame is too long to be taken apart
E806 runtime/analysis runtime/exports runtime/frame: numbers leave the range of floats
E807 runtime/frame: an operator over the others has no linearization inside a loop
E808 runtime runtime/frame: the equations have no finite value at the start
E809 runtime/frame: a time that follows from others is below zero
E810 runtime/analysis: a linearization does not hold while the scene moves
E811 runtime/frame: what is heard at one tick has several ages
E812 runtime/frame: too many states of one peer move together
E820 runtime: a command came to the end of the memory
E830 runtime/analysis: a box's range is written wrong
E831 runtime/analysis: a parameter can't be left open in a box
E832 runtime/analysis: a scene's equations can't be enclosed over a box
E833 runtime/analysis: a box's range is empty or out of bounds
E841 runtime/cli: the words of a command stand in another order
E842 runtime/vary: limits leave nothing to search
E843 runtime/vary: a limit is out of its parameter's bounds
E844 runtime/vary: a time can't be varied continuously
E845 runtime/analysis: a delay can't be searched in a scene that is not linear
E846 runtime/vary: events coincide too often to be searched
E850 runtime runtime/analysis: a method can't serve a scene
E861 runtime/analysis: a scene has not the paper's form
E862 runtime/analysis: the paper's matrices would be too large
E863 runtime/analysis: a part takes too many decisions
E864 runtime/simulation: no one-sided contact whose buzz could be predicted
E870 runtime/simulation: a motion can't be played exactly
E871 runtime/simulation: a motion can't be integrated any further
E872 runtime/simulation: an equation has no solution while a scene is played
E873 runtime/simulation: no signal fits a pattern
E874 runtime/simulation: too many numbers to play at once
E875 runtime: a library is not installed
E876 runtime/present runtime/simulation: too many rows to keep in memory
E877 runtime/simulation: a run has no duration, or none above zero
E878 runtime: a file's suffix is none of a command's formats
E879 runtime/present: the file of a run can't be written, or not to its end
E880 runtime/cli: --over is not PATH=VALUES
E881 runtime/sweeps runtime/vary: values to sweep are written wrong
E883 runtime/cli runtime/sweeps runtime/vary: a sweep has nothing, too much or the same thing twice
E884 runtime/sweeps: a sweep can't compute what is asked of it
E885 runtime/sweeps: something else stands where a sweep keeps its parts
E886 runtime/regions: a published condition is written wrong
E887 runtime: a table needs a library that is not installed
E888 runtime/sweeps: a cluster can't compute
E889 runtime runtime/cli runtime/sweeps: processes can't compute, or not for ever
E891 runtime/network: a link's law of packets can't differ by group
E892 runtime/network: too many ways or packets to follow, or in too fine parts of time
E893 runtime/simulation: a missing value has no own one to stand in for it
E894 runtime/simulation: nothing is left to chance
E895 runtime/simulation: a process that played runs ended
E896 runtime/network: a number of unreliable links can't be varied
E897 runtime/moments: no pattern of losses that shakes the scene can be played
E898 runtime/moments runtime/vary: a scene can't be judged in mean square, or not what is varied
E901 runtime/regions: an axis of a region is missing or written wrong
E902 runtime/regions: a parameter is set or varied twice in a region
E903 runtime/regions: a parameter can't be an axis of a region
E904 runtime/regions: a point lies outside a region
E905 runtime/regions: a region has points that can't be analysed
E906 runtime/regions: there is no one effective gain to compare at
E907 runtime/cli runtime/regions: the panels of a region are written wrong
E910 runtime/simulation: a method to play by is not known
E911 runtime/simulation: a method's step is none
E912 runtime/simulation: a method's tolerance is none
E913 runtime/simulation: a method's step does not fit the scene
E915 runtime/simulation: a run has more rows than anyone waits for
E920 runtime/benchmark: the truths of hard cases can't be had
E921 runtime/benchmark runtime/cli: there is nothing to measure by the number of peers
E922 runtime/cli: a measurement shows a fault of the program
E930 runtime/cli runtime/frame runtime/hands runtime/vary: no such hands, or they don't go with what is asked
E931 runtime/frame runtime/hands: a peer has no device, or several that a hand might hold
E932 runtime/frame: a scene has hands already
E933 runtime/hands: a device can't be cut out of its scene, or the scene is too large for it
E934 runtime/hands: an unstable scene has no response in time
E935 runtime/hands: a frequency is none that a response is told of, or nothing ticks
E936 runtime/hands: a device is named that is not there
E940 runtime/comparison: what is to be compared is no stiffness, delay or loss
E941 runtime/comparison: a scene has several stiffnesses, delays or losses to compare
E950 runtime/exports: a loop is to be cut where there is no link or coupler
E951 runtime/exports: a state space is too large for the memory or a file
E952 runtime/exports: a format to export to is not known
E953 runtime/exports: an option means nothing to the format
E954 runtime/exports: a number can't be left free
E955 runtime/exports: Modelica has no words for what a scene says
E960 runtime/exports: what a peer or a scene does is not written as C
E961 runtime/exports: what of a peer is its device can't be said, or can't be told apart from a copy
E962 runtime/exports: there is no C compiler, or it doesn't take a text
E963 runtime/exports: a peer is to be named, or the name is none
E970 runtime/loop: there is no such peer
E971 runtime/loop runtime/cli: a peer has no address, or it is none
E972 runtime/loop: nobody told a peer when its scene begins
E973 runtime/loop: a folder is no run, or can't be one
E974 runtime/loop runtime/cli: a peer can't listen there, or its secret is none
E975 runtime/loop: a scene has more peers than processes, or one of these was lost
E976 runtime/loop: a device outside has no function, or that is at fault
E980 runtime/explore: a number has no slider
E981 runtime/explore: a process that computes ended
E982 runtime/explore: a port can't be listened on
E983 runtime/explore: a scene has nothing that moves, or that a push could move
E984 runtime/explore: a scene has no unreliable link
E990 runtime/present: a file is no report
E991 runtime/cli: a report's number is another one, computed anew
"""


def catalogue() -> list[tuple[str, frozenset[str], str]]:
    """Return each line of the catalogue: code, rooms, meaning."""
    found = []
    for line in CATALOGUE.splitlines():
        where, meaning = line.split(": ", 1)
        code, *rooms = where.split()
        found.append((code, frozenset(rooms), meaning))
    return found


def told() -> dict[str, frozenset[str]]:
    """Return the rooms in which each code stands."""
    found: dict[str, frozenset[str]] = {}
    for top in ("compiler", "runtime"):
        for path in (ROOT / top).rglob("*.py"):
            parts = path.relative_to(ROOT).parts
            room = "/".join(parts[:2]) if len(parts) > 2 else top
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and re.fullmatch(r"E\d{3}", str(node.value)):
                    found[str(node.value)] = found.get(str(node.value), frozenset()) | {room}
    return found


def test_a_code_has_one_meaning_and_a_meaning_one_code() -> None:
    codes, _, meanings = zip(*catalogue(), strict=True)
    assert len(set(codes)) == len(codes)
    assert len(set(meanings)) == len(meanings)


def test_codes_are_told_by_the_rooms_of_the_catalogue_and_by_no_others() -> None:
    assert told() == {code: rooms for code, rooms, _ in catalogue()}


def test_what_a_docstring_says_is_raised_can_be_raised() -> None:
    known = {code for code, _, _ in catalogue()}
    for top in ("compiler", "runtime"):
        for path in (ROOT / top).rglob("*.py"):
            named = set(re.findall(r"\bE\d{3}\b", path.read_text(encoding="utf-8")))
            assert named <= known, f"{path}: {named - known}"
