"""What a user is told: the whole sentence of each mistake, its place, and what to write instead."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from apc.__main__ import run
from apc.analysis.analysis import analyze
from apc.compiler.errors import ApcError
from apc.compiler.language.expression import FUNCTIONS
from apc.compiler.pipeline import check_definition, run_stages
from apc.frame.overrides import parse_override
from tests.topologies import AVERAGE, SCENES, compiled, library, replaced
from tests.topologies import told as told_of

# A component of the user's own, in a folder beside the topology.
PAD = """\
component: Pad
about: A pad between two flanges, computed at each tick.
connectors: {a: Flange, b: Flange}
parameters:
  stiffness: {unit: N/m, min: 0}
  damping: {unit: N*s/m, min: 0, default: 0}
  side: {unit: 1, options: {left: 1, right: -1}, default: 1}
  mode: {options: [soft, hard], default: soft}
  clock: clock
  delay: {unit: s, min: 0, default: 0}
variables:
  f: {unit: N}
equations:
  - f = stiffness*(sample(a.x) - sample(b.x)) + damping*(sample(der(a.x)) - sample(der(b.x)))
  - a.f = hold(f, delay)
  - b.f = -a.f
"""
WITH_PAD = replaced(AVERAGE, ("about:", "library: parts\nabout:"), ("SampledSpringDamper", "Pad"))
USERS = "device.mass [kg]\n1\n2\n"

# (what stands there, what a user writes instead, what is told)
TOPOLOGY = [
    (
        "clocks:",
        "clock:",
        "3:1: E202 a topology has no key clock; the nearest is clocks. Write: clocks",
    ),
    (
        "topology: three-users-average\n",
        "",
        "1:1: E201 the topology has no topology. Write: topology: my-scene",
    ),
    (
        "peers:\n  user: {count: 3}\n",
        "",
        "1:1: E201 the topology has no peers section. Write: peers: {user: {count: 3}}",
    ),
    (
        "masses:",
        "masss:",
        "8:1: E202 a topology has no key masss; the nearest is masses. Write: masses",
    ),
    (
        "haptic: 1 ms",
        "haptic: 1",
        "4:11: E204 haptic wants a time or a rate, got 1 (no unit). Write: haptic: 1 ms, or haptic: 1 Hz",
    ),
    (
        "haptic: 1 ms",
        "haptic: 1 kg",
        "4:11: E204 haptic wants ms, got 1 kg.",
    ),
    (
        "haptic: 1 ms",
        "haptic: fast",
        "4:11: E206 haptic names fast, which is no parameter here; there are: peers.",
    ),
    (
        "haptic: 1 ms",
        "haptic: [1 ms]",
        "4:11: E203 haptic wants a single value, got a list. Write: haptic: 1 ms",
    ),
    (
        "haptic: 1 ms",
        "haptic: 0 ms",
        "4:11: E207 the period of clock haptic wants more than 0 s, got 0 s. Write: haptic: 1 ms",
    ),
    (
        "haptic: 1 ms",
        "haptic: 0 Hz",
        "4:11: E207 haptic wants a rate above 0 Hz, got 0 Hz.",
    ),
    (
        "haptic: 1 ms",
        "haptic: -1 ms",
        "4:11: E207 the period of clock haptic wants more than 0 s, got -0.001 s. Write: haptic: 1 ms",
    ),
    (
        "haptic: 1 ms",
        "haptic: {period: 1 ms, phase: 2 ms}",
        "4:33: E207 the phase of clock haptic wants 0 s or more and less than its period, got 0.002 s.",
    ),
    (
        "haptic: 1 ms",
        "haptic: {phase: 0 ms}",
        "4:11: E201 clock haptic has no period. Write: period: 1 ms",
    ),
    (
        "haptic: 1 ms",
        "haptic: {period: 1 ms, offset: 0 ms}",
        "4:26: E202 clock haptic has no key offset; there are: period, phase.",
    ),
    (
        "haptic: 1 ms",
        "haptic:",
        "4:10: E203 haptic wants a single value, got nothing. Write: haptic: 1 ms",
    ),
    (
        "haptic: 1 ms",
        "haptic: 1 ms\n  haptic: 2 ms",
        "5:3: E111 'haptic' stands twice, first in line 4.",
    ),
    (
        "haptic: 1 ms",
        "haptic:1 ms",
        "4:3: E109 a key stands here without its colon and a space. Write: haptic: 1 ms",
    ),
    (
        "user: {count: 3}",
        "user: {count: three}",
        "7:17: E208 count wants a whole number, or an expression over numbers of parameters, got three. "
        "Write: count: 3",
    ),
    (
        "user: {count: 3}",
        "user: {count: 0}",
        "7:17: E208 count wants a whole number from 1 to 1000000000, got 0. Write: count: 3",
    ),
    (
        "user: {count: 3}",
        "user: {count: 2.5}",
        "7:17: E208 count wants a whole number from 1 to 1000000000, got 2.5. Write: count: 3",
    ),
    (
        "user: {count: 3}",
        "user: {}",
        "7:9: E201 group user has no count. Write: count: 3",
    ),
    (
        "user: {count: 3}",
        "user: 3",
        "7:9: E203 user wants a mapping of keys to values, got 3. Write: user: {count: 3}",
    ),
    (
        "user: {count: 3}",
        "user: {count: 1}",
        "13:3: E208 coordination (AveragePosition) follows the other peers and wants at least 2 "
        "peers, got 1. Write: count: 2",
    ),
    (
        "  user: {count: 3}",
        "  {}",
        "7:3: E201 peers names no group. Write: peers: {user: {count: 3}}",
    ),
    (
        "count: 3}",
        "count: 3, set: {device.mas: 1 kg}}",
        "7:26: E206 set names device.mas, which is no parameter or variable of a part; the "
        "nearest is device.mass. Write: device.mass",
    ),
    (
        "count: 3}",
        "count: 3, set: {device: 1 kg}}",
        "7:26: E206 set names device, which is no parameter or variable of a part; the nearest "
        "is device.x. Write: device.x",
    ),
    (
        "count: 3}",
        "count: 3, set: {device.mass: 1 N}}",
        "7:39: E204 device.mass wants kg, got 1 N. Write: device.mass: 1 kg",
    ),
    (
        "count: 3}",
        "count: 3, set: {device.mass: [1 kg, 2 kg]}}",
        "7:39: E208 the list of device.mass wants a value a peer, 3 in all, got 2.",
    ),
    (
        "count: 3}",
        "count: 3, set: {coordination.delays: own half}}",
        "7:47: E206 coordination.delays has no option own half; there are: all, own.",
    ),
    (
        "count: 3}",
        "count: 3, set: {contact.clock: hapti}}",
        "7:41: E206 contact.clock has no clock hapti; the nearest is haptic. Write: haptic",
    ),
    (
        "count: 3}",
        "count: 3, set: [device.mass]}",
        "7:25: E203 set wants a mapping of keys to values, got a list. Write: set: {device.mass: 0.2 kg}",
    ),
    (
        "count: 3}",
        "table: nobody.csv}",
        "7:17: E701 the table nobody.csv does not exist.",
    ),
    (
        "mass: 0.1 kg, damping: 5 N*s/m}\n",
        "mass: 0.1, damping: 5 N*s/m}\n",
        "9:18: E204 mass wants kg, got 0.1 (no unit). Write: mass: 0.1 kg",
    ),
    (
        "0.1 kg",
        "0 kg",
        "9:18: E207 mass wants more than 0 kg, got 0 kg.",
    ),
    (
        "0.1 kg",
        "-1 kg",
        "9:18: E207 mass wants more than 0 kg, got -1 kg.",
    ),
    (
        "0.1 kg",
        "0.1kg*",
        "9:24: E222 a unit wants a name such as N, m or s, got its end.",
    ),
    (
        "0.1 kg",
        ".nan",
        "9:18: E221 mass wants kg, got .nan. Write: mass: 1 kg",
    ),
    (
        "0.1 kg",
        "1e999 kg",
        "9:18: E226 a number wants an exponent from -300 to 300, got 999.",
    ),
    (
        "0.1 kg",
        '""',
        "9:18: E203 mass wants a single value, got nothing. Write: mass: 1 kg",
    ),
    (
        "0.1 kg",
        "light",
        "9:18: E206 mass names light, which is no parameter here; there are: peers.",
    ),
    (
        "0.1 kg",
        "2*light",
        "9:20: E206 mass names light, which is no parameter here; there are: peers.",
    ),
    (
        "0.1 kg",
        "1 degC",
        "9:20: E224 degC (degree_Celsius) is no multiple of an SI unit. Write: K",
    ),
    (
        "0.1 kg",
        "0.1 KG",
        "9:22: E223 there is no unit KG. Write: kg",
    ),
    (
        "0.1 kg",
        "0.1 Kg",
        "9:22: E223 there is no unit Kg. Write: kg",
    ),
    (
        "mass: 0.1 kg, ",
        "",
        "9:3: E201 device has no mass. Write: mass: 1 kg",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {type: Mas, mass: 0.1 kg, damping: 5 N*s/m}",
        "9:18: E206 there is no component Mas; the nearest is Mass. Write: Mass",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, dampng: 5 N*s/m}",
        "9:26: E202 device (Mass) has no key dampng; the nearest is damping. Write: damping",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, damping: 5 N*s/m, shared: yes}",
        "9:52: E203 shared wants true or false, got yes. Write: shared: true",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, damping: 5 N*s/m, at: user}",
        "9:48: E203 at wants a list of groups, got user. Write: at: [user]",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, damping: 5 N*s/m, at: [usr]}",
        "9:49: E206 device is at usr, which is no group of peers; the nearest is user. Write: user",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, damping: 5 N*s/m, count: 2}",
        '12:48: E210 contact is one part and device[1:2] has 2 elements. Write: a: "device[1]"',
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 kg}",
        "9:47: E204 x wants m, got 1 kg. Write: x: 1 m",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: 0.1 kg",
        "9:11: E203 device wants a mapping of keys to values, got 0.1 kg. Write: device: {mass: 0.1 kg}",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, damping: 5 N*s/m",
        "9:11: E109 this { is never closed, or a comma is missing behind it.",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "\tdevice: {mass: 0.1 kg, damping: 5 N*s/m}",
        "9:1: E109 a tab indents this line, and YAML allows spaces only. Write: spaces",
    ),
    (
        "  device: {mass: 0.1 kg, damping: 5 N*s/m}",
        "  device: {mass: 0.1 kg, mass: 5 kg}",
        "9:26: E111 'mass' stands twice, first in line 9.",
    ),
    (
        "type: SampledSpringDamper, ",
        "",
        "12:3: E201 contact has no type. Write: type: SampledSpringDamper",
    ),
    (
        "type: SampledSpringDamper",
        "type: SpringDampr",
        "12:24: E206 there is no component SpringDampr; the nearest is SpringDamper. Write: SpringDamper",
    ),
    (
        "type: SampledSpringDamper",
        "type: Flange",
        "12:24: E206 Flange is a connector type, not a component. Write: type: SampledSpringDamper",
    ),
    (
        "a: device, b: cube",
        "a: device",
        "12:3: E210 contact does not say what its b is joined to. Write: b: cube",
    ),
    (
        "a: device, b: cube",
        "a: device, b: cub",
        "12:59: E206 contact joins its b to cub, which is no part of this topology; the nearest "
        "is cube. Write: cube",
    ),
    (
        "a: device, b: cube",
        "a: device, b: device",
        "12:3: E210 contact joins device to itself.",
    ),
    (
        "a: device, b: cube",
        "a: device, b: cube.tip",
        "12:59: E206 cube (Mass) has no Flange called tip; there are: flange.",
    ),
    (
        "a: device, b: cube",
        "a: device, b: lan",
        "12:59: E210 lan (Link) has no connector of type Flange to join b to.",
    ),
    (
        "a: device, b: cube",
        "a: device, b: the cube",
        "12:59: E210 b wants a part, such as device, device.flange or chain[2], got the cube.",
    ),
    (
        "stiffness: 1000 N/m, ",
        "",
        "12:3: E201 contact has no stiffness. Write: stiffness: 1 N/m",
    ),
    (
        "1000 N/m",
        "1000 N",
        "12:76: E204 stiffness wants N/m, got 1000 N. Write: stiffness: 1000 N/m",
    ),
    (
        "1000 N/m",
        "-5 N/m",
        "12:76: E207 stiffness wants 0 N/m or more, got -5 N/m.",
    ),
    (
        "1000 N/m",
        "1000",
        "12:76: E204 stiffness wants N/m, got 1000 (no unit). Write: stiffness: 1000 N/m",
    ),
    (
        "1000 N/m",
        "{value: 1000 N/m}",
        "12:76: E203 stiffness wants a single value, got a mapping. Write: stiffness: 1 N/m",
    ),
    (
        "clock: haptic, delay: 1 ms}",
        "clock: hapti, delay: 1 ms}",
        "12:93: E206 contact names clock hapti, which isn't in clocks; the nearest is haptic. Write: haptic",
    ),
    (
        "clock: haptic, delay: 1 ms}",
        "delay: 1 ms}",
        "12:3: E201 contact has no clock. Write: clock: haptic",
    ),
    (
        "clock: haptic, delay: 1 ms}",
        "clock: haptic, delay: -1 ms}",
        "12:108: E207 delay wants 0 ms or more, got -1 ms.",
    ),
    (
        "clock: haptic, delay: 1 ms}",
        "clock: haptic, delay: 1 m}",
        "12:108: E204 delay wants ms, got 1 m. Write: delay: 1 ms",
    ),
    (
        "link: lan}",
        "link: lam}",
        "13:109: E206 coordination names link lam, which isn't in links; the nearest is lan. Write: lan",
    ),
    (
        "link: lan}",
        "link: haptic}",
        "13:109: E206 coordination names link haptic, which isn't in links; there are: lan.",
    ),
    (
        ", link: lan}",
        "}",
        "13:3: E201 coordination has no link. Write: link: lan",
    ),
    (
        "link: lan}",
        "link: lan, delays: some}",
        "13:122: E206 delays wants all or own, got some. Write: delays: all",
    ),
    (
        "object: cube",
        "object: lan",
        "13:49: E210 lan (Link) has no connector of type Flange to join object to.",
    ),
    (
        "object: cube, ",
        "",
        "13:3: E210 coordination does not say what its object is joined to. Write: object: device",
    ),
    (
        "links:\n  lan: {clock: network, delay: 8 ms}\n",
        "",
        "1:1: E201 the topology has no links section. Write: links: {lan: {clock: network}}",
    ),
    (
        "clock: network, delay",
        "clock: netwrk, delay",
        "15:16: E206 lan names clock netwrk, which isn't in clocks; the nearest is network. Write: network",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: rng}",
        "15:45: E206 there is no graph rng; the nearest is ring. Write: ring",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: {edges: [[1, 4]]}}",
        '15:58: E213 a peer wants a number from 1 to 3, or a name in quotes such as "user[1]", got 4.',
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: {edges: [[1, 1]]}}",
        "15:54: E213 peer 1 can't be joined to itself.",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: {edges: [[1, 2], [2, 1]]}}",
        "15:62: E213 the pair 2, 1 is given twice.",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: {edges: [[1, 2, 0]]}}",
        "15:61: E203 a weight wants a number other than 0, got 0. Write: 0.5",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: {edges: net.csv}}",
        "15:53: E701 the table net.csv does not exist.",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: {}}",
        "15:45: E203 graph wants either edges or arcs. Write: edges: [[1, 2], [2, 3]]",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, delays: {user: {usr: 1 ms}}}",
        "15:54: E206 delays names usr, which is no group of peers; the nearest is user. Write: user",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, delays: {user: {user: -1 ms}}}",
        "15:60: E207 a delay wants 0 s or more, got -0.001 s.",
    ),
    (
        "delay: 8 ms}",
        "delay: 8 ms, count: 2}",
        "15:45: E208 the count of lan wants no count, as a link is one, got 2.",
    ),
    (
        "contact.stiffness: [0 N/m, 5000 N/m]",
        "contact.stifness: [0 N/m, 5000 N/m]",
        "17:16: E206 x names contact.stifness, which is no parameter of a part; the nearest is "
        "contact.stiffness. Write: contact.stiffness",
    ),
    (
        "contact.stiffness: [0 N/m, 5000 N/m]",
        "contact.stiffness: [5000 N/m, 0 N/m]",
        "17:35: E207 the range of contact.stiffness wants its lower end first, got 5000 N/m to 0 N/m.",
    ),
    (
        "contact.stiffness: [0 N/m, 5000 N/m]",
        "contact.stiffness: 5000 N/m",
        "17:35: E203 contact.stiffness wants a list of two values, got 5000 N/m. Write: x: "
        "{contact.stiffness: [0 N/m, 5000 N/m]}",
    ),
    (
        "studies:",
        "study:",
        "16:1: E202 a topology has no key study; the nearest is studies. Write: studies",
    ),
    (
        "studies:",
        "experiment: {duration: 0 s}\nstudies:",
        "16:24: E207 duration wants more than 0 s, got 0 s.",
    ),
    (
        "studies:",
        "experiment: {duration: 3}\nstudies:",
        "16:24: E204 duration wants s, got 3 (no unit). Write: duration: 3 s",
    ),
    (
        "studies:",
        "experiment: {seed: x}\nstudies:",
        "16:20: E203 seed wants a whole number, 0 or more, got x.",
    ),
    (
        "studies:",
        "parameters: {kt: kt}\nstudies:",
        "16:18: E209 parameters depend in a circle: kt → kt.",
    ),
    (
        "studies:",
        "parameters: {kt: ks + 1}\nstudies:",
        "16:18: E206 kt names ks, which is no parameter here; there are: peers.",
    ),
    (
        "studies:",
        "parameters: {kt: 2 N/m, kp: kt + 1}\nstudies:",
        "16:34: E402 1 wants N/m like kt, got a plain number.",
    ),
    (
        "studies:",
        "parameters: {kt: 1/0}\nstudies:",
        "16:18: E221 1/0 divides by zero.",
    ),
    (
        "studies:",
        "parameters: {sqrt: 1}\nstudies:",
        "16:14: E205 sqrt is a word of the language and can't be a name.",
    ),
    (
        "studies:",
        "parameters: [1]\nstudies:",
        "16:13: E203 parameters wants a mapping of keys to values, got a list. Write: "
        "parameters: {kt: 2000 N/m}",
    ),
    (
        "studies:",
        "library: ./nowhere\nstudies:",
        "16:10: E214 the library folder ./nowhere does not exist.",
    ),
    (  # longer than any file system's names
        "studies:",
        f"library: {'x' * 300}\nstudies:",
        f"16:10: E214 the library folder {'x' * 57}... can't be read: File name too long.",
    ),
    (
        "500 N/m,",
        "peers*100,",
        "13:66: E204 stiffness wants N/m, got peers*100, which has no unit. Write: stiffness: 1 N/m",
    ),
    (
        "500 N/m,",
        "sqrt(,",
        "13:71: E322 a number, a name or ( was expected here, not the end of the text.",
    ),
    (
        "500 N/m,",
        "kt/(peers - 1),",
        "13:66: E206 stiffness names kt, which is no parameter here; there are: peers.",
    ),
    (
        "500 N/m,",
        '"500 N/m/(peers - 1)",',
        "13:66: E204 stiffness wants a number with its unit, or an expression without units, "
        "got 500 N/m/(peers - 1). Write: stiffness: total/(peers - 1), with parameters: {total: "
        "500 N/m}",
    ),
    (
        "500 N/m,",
        '"__import__(1)",',
        "13:67: E324 a name wants a letter first, got __import__.",
    ),
    (
        "500 N/m,",
        "*k,",
        "13:66: E114 *k has no &k before it.",
    ),
    (
        "clocks:",
        "<<: {a: 1}\nclocks:",
        "3:1: E116 the merge key << is not part of this language. Write: the keys themselves, "
        "or an alias as the value of a key",
    ),
    (
        "clocks:",
        "---\nclocks:",
        "3:1: E110 a file wants one YAML document, got the start of a second one.",
    ),
    (
        "clocks:",
        "x: !!python/name:os.system\nclocks:",
        "3:4: E113 the tag '!!python/name:os.system' is not part of this language.",
    ),
    (
        "clocks:",
        "x: &a [*a]\nclocks:",
        "3:8: E114 *a stands inside what it repeats: it would never end.",
    ),
    (
        "studies:",
        "hands:\n  hand: {type: ConstantForce, force: 1 N}\nstudies:",
        "17:3: E210 hand does not say what its flange is joined to. Write: flange: device",
    ),
    (
        "studies:",
        "hands:\n  hand: {type: TableForce, flange: device}\nstudies:",
        "17:3: E201 hand has no force. Write: force: force.csv",
    ),
    (
        "studies:",
        "hands:\n  hand: {type: TableForce, flange: device, force: push.csv}\nstudies:",
        "17:51: E701 the table push.csv does not exist.",
    ),
    (
        "studies:",
        "hands:\n  hand: {flange: device, force: 1 N}\nstudies:",
        "17:3: E201 hand has no type. Write: type: ConstantForce",
    ),
]

COMPONENT = [
    (
        "about: A pad",
        "abut: A pad",
        "2:1: E202 a component has no key abut; the nearest is about. Write: about",
    ),
    (
        "a: Flange, b: Flange",
        "a: Flange, b: Flnge",
        "3:28: E206 there is no connector type Flnge; the nearest is Flange. Write: Flange",
    ),
    (
        "{unit: N/m, min: 0}",
        "{min: 0}",
        "5:14: E201 stiffness has no unit. Write: stiffness: {unit: N/m}  (unit: 1 when it has none)",
    ),
    (
        "{unit: N/m, min: 0}",
        "{unit: N/mm/, min: 0}",
        "5:26: E222 a unit wants a name such as N, m or s, got its end.",
    ),
    (
        "{unit: N/m, min: 0}",
        "{unit: N/m, min: 0 N}",
        "5:31: E204 stiffness wants N/m, got 0 N. Write: stiffness: 0 N/m",
    ),
    (
        "{unit: N/m, min: 0}",
        "stiff",
        "5:14: E203 parameter stiffness wants clock, link, graph, delays, loss, trace, table, or a mapping "
        "with its unit, got stiff. Write: stiffness: {unit: N/m, min: 0}",
    ),
    (
        "default: soft",
        "default: sft",
        "8:42: E206 mode has no option sft; the nearest is soft. Write: soft",
    ),
    (
        "clock: clock",
        "time: clock",
        "9:9: E205 time is a word of the language and can't be a name.",
    ),
    (
        "f: {unit: N}",
        "f: N",
        "12:6: E203 f wants a mapping of keys to values, got N. Write: f: {unit: N}",
    ),
    (
        "f: {unit: N}",
        "f: {unit: N}\n  stiffness: {unit: N/m}",
        "13:3: E205 the name stiffness is used twice in this component.",
    ),
    (
        "b.f = -a.f",
        "b.f -a.f",
        "16:13: E329 an equation wants one =, as in a = b, got none.",
    ),
    (
        "b.f = -a.f",
        "b.f = a.f = 0",
        "16:15: E329 an equation wants one =, got a second one.",
    ),
    (
        "b.f = -a.f",
        "b.f == -a.f",
        "16:16: E329 an equation wants one =, got ==, which compares. Write: b.f = -a.f",
    ),
    (
        "b.f = -a.f",
        "b.f = -a.g",
        "16:12: E303 Pad has no a.g; the nearest is a.x. Write: a.x",
    ),
    (
        "b.f = -a.f",
        "b.f = -(a.f",
        "16:16: E322 an opened ( wants ), got the end of the text.",
    ),
    (
        "b.f = -a.f",
        "b.f = -a.f)",
        "16:15: E322 this ) closes nothing.",
    ),
    (
        "b.f = -a.f",
        "b.f = -sn(a.x)",
        "16:12: E325 there is no function sn. Write: sin(…)",
    ),
    (
        "b.f = -a.f",
        "b.f = -a.f*2 N",
        "16:16: E323 2 N is not a number, and units stand on parameters only. Write: a "
        "parameter, with default: 2 N; of a name, 2*name",
    ),
    (
        "b.f = -a.f",
        "b.f = -a.f/0",
        "16:5: E512 `contact.b.f = -contact.a.f/0` (contact) holds a constant that is no "
        "number, such as 1/0 or sqrt(-1).",
    ),
    (
        "b.f = -a.f",
        "b.f = -max(a.f, b.x)",
        "16:21: E404 b.x wants N like a.f, got m.",
    ),
    (
        "b.f = -a.f",
        "b.f = -hold(f, delay, delay)",
        "16:12: E325 hold wants 1 to 2 arguments, got 3.",
    ),
    (
        "b.f = -a.f",
        "b.f = -a.f^x",
        "16:16: E326 an exponent wants a number written out, as in x^2 or x^(1/2), got x.",
    ),
    (
        "b.f = -a.f",
        "b.f = if a.x > 0 then a.f",
        "16:30: E322 an if … then wants else, got the end of the text.",
    ),
    (
        "b.f = -a.f",
        "b.f = -stiffness*a.x[1]",
        "16:22: E408 a.x[1] wants a vector before the index, got a.x, which is a number. Write: a.x",
    ),
    (
        "b.f = -a.f",
        "b.f = -__class__",
        "16:12: E324 a name wants a letter first, got __class__.",
    ),
    (
        "b.f = -a.f",
        "b.f = -'a.f'",
        "16:12: E321 ' cannot stand here: an expression holds no quoted text.",
    ),
    (
        "b.f = -a.f",
        "b.f = −a.f",
        "16:11: E321 an expression wants ASCII letters, digits and + - * / ^ ( ), got − "
        "(U+2212, MINUS SIGN). Write: -",
    ),
    (
        "  - b.f = -a.f\n",
        "",
        "1:12: E501 Pad is unbalanced: 2 equations for 3 unknowns (f, a.f, b.f). Write: one "
        "equation for each variable and one for each flow of a connector",
    ),
    (
        "  - b.f = -a.f\n",
        "  - b.f = -a.f\n  - a.f = -b.f\n",
        "1:12: E501 Pad is unbalanced: 4 equations for 3 unknowns (f, a.f, b.f). Write: one "
        "equation for each variable and one for each flow of a connector",
    ),
    (
        "b.f = -a.f",
        "b.f = -hold(a.f)",
        "16:5: E505 hold(contact.a.f, 0) holds contact.a.f, which is continuous already. Write: contact.a.f",
    ),
    (
        "b.f = -a.f",
        "b.f = -hold(previous(f))",
        "16:5: E507 previous(contact.f) needs a start value of contact.f. Write: variables: {f: "
        "{unit: …, start: 0}}",
    ),
    (
        "b.f = -a.f",
        "b.f = -hold(stiffness*mean(others.x))",
        "16:32: E303 Pad sends nothing called x. Write: sends: {x: sample(object.x)}",
    ),
    (
        "b.f = -a.f",
        "b.f = -hold(stiffness*others.x)",
        "16:27: E303 Pad sends nothing called x. Write: sends: {x: sample(object.x)}",
    ),
    (
        "a.f = hold(f, delay)",
        "a.f = hold(f, damping)",
        "15:19: E405 damping wants s, as a delay, got N*s/m.",
    ),
    (
        "clock: clock\n",
        "clock: clok\n",
        "9:10: E203 parameter clock wants clock, link, graph, delays, loss, trace, table, or a mapping with "
        "its unit, got clok. Write: clock: {unit: N/m, min: 0}",
    ),
    (
        "component: Pad",
        "component: Pad\nextends: Mas",
        "2:10: E206 there is no component Mas; the nearest is Mass. Write: Mass",
    ),
    (
        "component: Pad",
        "component: Pad\nextends: Pad",
        "1:1: E212 components contain or extend each other: Pad → Pad.",
    ),
    (
        "side: {unit: 1, options: {left: 1, right: -1}, default: 1}",
        "side: {unit: 1, options: {left: one}}",
        "7:35: E221 left wants a plain number, got one. Write: left: 1",
    ),
]

FILES = [
    (b"", ": E108 this file is empty."),
    (b"# nothing\n", ": E108 this file is empty."),
    (b"\xff\xfe", ":1:1: E106 a YAML file wants UTF-8 text, got byte 0xff at offset 0."),
    (
        b"- a\n- b\n",
        ":1:1: E203 a topology wants a mapping of keys to values, got a list. Write: topology: my-scene",
    ),
    (
        b"just text\n",
        ":1:1: E203 a topology wants a mapping of keys to values, got just text. Write: topology: my-scene",
    ),
    (b"[1, 2\n", ":1:1: E109 this [ is never closed, or a comma is missing behind it."),
    (
        b"{a: 1}}\n",
        ":1:7: E109 this line belongs to nothing above it: its indent or a closing bracket is wrong.",
    ),
    (b"? [a]\n: b\n", ":1:3: E112 a key wants a name, got a list."),
    (b"a: 'x\n", ":1:4: E109 this quote is never closed."),
    (b"a: @x\n", ":1:4: E109 a text starting with @ needs quotes. Write: '@x'"),
    (
        b"a: b: c\n",
        ":1:5: E109 a ': ' cannot stand here: the line above ends wrongly, or the text "
        "needs quotes. Write: key: 'text: with a colon'",
    ),
    (
        b" a: 1\nb: 2\n",
        ":2:1: E109 this line belongs to nothing above it: its indent or a closing bracket is wrong.",
    ),
    (b"a: {x: O[1], y: 1}\n", ':1:8: E109 a text with [ in it needs quotes here. Write: "O[1]"'),
    (b"a: [r = {1, 2}]\n", ':1:5: E109 a text with { in it needs quotes here. Write: "r = {1, 2}"'),
    (b"a: {x: [1] [2]}\n", ":1:4: E109 this { is never closed, or a comma is missing behind it."),
    (b"a: {x: 'O' [1]}\n", ":1:4: E109 this { is never closed, or a comma is missing behind it."),
    (b"{a: \n", ":2:1: E109 a value or a closing bracket is missing here."),
    (b"a: 1\n\tb: 2\n", ":2:1: E109 a tab indents this line, and YAML allows spaces only. Write: spaces"),
]


def told(folder: Path, monkeypatch: pytest.MonkeyPatch, files: dict[str, str]) -> list[str]:
    """Return the mistakes of the topology in a folder, to which files are written first."""
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(folder)
    with pytest.raises(ApcError) as caught:
        run_stages(Path("scene.yaml"), until="compiled")
    return [str(mistake) for mistake in caught.value.mistakes]


@pytest.mark.parametrize(("old", "new", "message"), TOPOLOGY)
def test_a_slip_in_a_topology_is_told_once_where_it_is(
    old: str, new: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {"scene.yaml": replaced(AVERAGE, (old, new)), "users.csv": USERS}
    assert [one.splitlines()[0] for one in told(tmp_path, monkeypatch, files)] == [f"scene.yaml:{message}"]


@pytest.mark.parametrize(("old", "new", "message"), COMPONENT)
def test_a_slip_in_a_component_is_told_once_where_it_is(
    old: str, new: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {"scene.yaml": WITH_PAD, "parts/pad.yaml": replaced(PAD, (old, new))}
    assert [one.splitlines()[0] for one in told(tmp_path, monkeypatch, files)] == [
        f"parts/pad.yaml:{message}"
    ]


def test_the_line_is_shown_with_a_caret_under_the_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = replaced(AVERAGE, ("haptic: 1 ms", "haptic: 1 kg"))
    assert told(tmp_path, monkeypatch, {"scene.yaml": text}) == [
        "scene.yaml:4:11: E204 haptic wants ms, got 1 kg.\n      haptic: 1 kg\n              ^"
    ]


@pytest.mark.parametrize(("data", "message"), FILES)
def test_a_file_that_is_no_topology_is_told_in_one_sentence(
    data: bytes, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scene.yaml").write_bytes(data)
    [found] = told(tmp_path, monkeypatch, {})
    assert found.splitlines()[0] == f"scene.yaml{message}"


def test_what_is_written_as_told_is_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six slips; with the line that each message says to write, none is left."""
    wrong = replaced(
        AVERAGE,
        ("haptic: 1 ms", "haptic: 1 kg"),
        ("0.1 kg", "0.1"),
        ("shared: true", "shared: yes"),
        ("a: device, ", ""),
        ("stiffness: 1000 N/m, ", ""),
        ("link: lan", "link: lam"),
    )
    assert len(told(tmp_path, monkeypatch, {"scene.yaml": wrong})) == 6
    right = replaced(
        wrong,
        ("haptic: 1 kg", "haptic: 1 s"),
        ("mass: 0.1,", "mass: 0.1 kg,"),
        ("shared: yes", "shared: true"),
        ("b: cube,", "b: cube, a: device, stiffness: 1 N/m,"),
        ("link: lam", "link: lan"),
    )
    (tmp_path / "scene.yaml").write_text(right, encoding="utf-8")
    run_stages(Path("scene.yaml"), until="compiled")


def test_all_mistakes_of_a_file_come_together_in_its_order_each_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = replaced(
        AVERAGE,
        ("haptic: 1 ms", "haptic: 1 kg"),
        ("network: 8 ms", "network: 0 s"),
        ("user: {count: 3}", "user: {count: 3, set: {device.mas: 1 kg}}"),
        ("0.1 kg", "0.1"),
        ("shared: true", "shared: yes"),
        ("a: device", "a: devise"),
        ("1000 N/m", "1000 N"),
        ("delay: 1 ms}\n", "delay: -1 ms}\n"),
        ("type: AveragePosition", "type: AveragPosition"),
        ("delay: 8 ms}", "delay: 8 s m, graph: rng}"),
        ("contact.stiffness: [0 N/m, 5000", "contact.stifness: [0 N/m, 5000"),
        ("studies:", "experiment: {seed: x}\nstudies:"),
    )
    assert [one.splitlines()[0] for one in told(tmp_path, monkeypatch, {"scene.yaml": text})] == [
        "scene.yaml:4:11: E204 haptic wants ms, got 1 kg.",
        "scene.yaml:5:12: E207 the period of clock network wants more than 0 s, got 0 s. Write: "
        "network: 1 ms",
        "scene.yaml:7:26: E206 set names device.mas, which is no parameter or variable of a part; "
        "the nearest is device.mass. Write: device.mass",
        "scene.yaml:9:18: E204 mass wants kg, got 0.1 (no unit). Write: mass: 0.1 kg",
        "scene.yaml:10:52: E203 shared wants true or false, got yes. Write: shared: true",
        "scene.yaml:12:48: E206 contact joins its a to devise, which is no part of this topology; "
        "the nearest is device. Write: device",
        "scene.yaml:12:76: E204 stiffness wants N/m, got 1000 N. Write: stiffness: 1000 N/m",
        "scene.yaml:12:106: E207 delay wants 0 ms or more, got -1 ms.",
        "scene.yaml:13:24: E206 there is no component AveragPosition; the nearest is "
        "AveragePosition. Write: AveragePosition",
        "scene.yaml:15:36: E222 a unit wants * or / between two names, got m. Write: s*m",
        "scene.yaml:15:46: E206 there is no graph rng; the nearest is ring. Write: ring",
        "scene.yaml:16:20: E203 seed wants a whole number, 0 or more, got x.",
        "scene.yaml:18:16: E206 x names contact.stifness, which is no parameter of a part; the "
        "nearest is contact.stiffness. Write: contact.stiffness",
    ]


FAULTS = """\
component: Pad
connectors: {flange: Flange}
parameters: {k: {unit: N/m}}
variables: {e: N}
equations:
  - f = k*flange.y
  - g = clamp(f)
  - flange.f = g + q
"""


def test_every_mistake_of_a_component_is_told_at_once(tmp_path: Path) -> None:
    """An equation that can't be read hides neither another's unknown names nor gives any of its own."""
    (tmp_path / "pad.yaml").write_text(FAULTS.replace("{e: N}", "{e: {unit: N}}"))
    with pytest.raises(ApcError) as caught:
        check_definition(tmp_path / "pad.yaml")
    assert [mistake.sentence for mistake in caught.value.mistakes] == [
        "Pad has no flange.y; the nearest is flange.x. Write: flange.x",
        f"there is no function clamp; there are: {', '.join(sorted(FUNCTIONS))}.",
        "Pad has no q; there are: e, f, flange.f, flange.x, g, k, others, peers, time.",
    ]


CLOCKED = """\
component: Pad
connectors: {a: Flange, b: Flange}
parameters: {k: {unit: N/m}, clock: clock}
equations:
  - a.f = k*(sample(a.x) - sample(b.x))
  - b.f = -a.f
"""


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "",
            "",
            "5:5: E505 Pad.a.f acts on what it is joined to at all times, and is on clock clock. "
            "Write: a.f = hold(k*(sample(a.x) - sample(b.x)))",
        ),
        (
            "clock: clock}",
            "clock: clock, slow: clock}",
            "5:14: E504 Pad samples, and has clocks clock, slow. Write: sample(a.x, clock)",
        ),
        (
            ", clock: clock}",
            "}",
            "5:14: E504 Pad samples but has no parameter that names one clock. "
            "Write: parameters: {clock: clock}",
        ),
        (
            "a: Flange, b: Flange}\nparameters: {k: {unit: N/m}, clock: clock}",
            "a: PlanarFlange, b: PlanarFlange}\nparameters: {k: {unit: N/m}, clock: clock, slow: clock}",
            "5:14: E504 Pad samples, and has clocks clock, slow. Write: sample(a.x, clock)",
        ),
    ],
)
def test_what_no_scene_can_mend_of_clocks_is_told_of_a_component_by_itself(
    old: str, new: str, told: str, tmp_path: Path
) -> None:
    path = tmp_path / "pad.yaml"
    path.write_text(CLOCKED.replace(old, new, 1))
    with pytest.raises(ApcError) as caught:
        check_definition(path)
    found = [str(mistake).partition("\n")[0] for mistake in caught.value.mistakes]
    assert found[0] == f"{path}:{told}"
    assert len(found) == 1 + told.count("E504"), "a sample each"


HEARING = """\
component: Pad
connectors: {a: Flange}
sends: {x: sample(a.x)}
parameters: {k: {unit: N/m}, role: {options: [client, server], default: client}, clock: clock, link: link}
equations:
  - a.f = hold(k*(sample(a.x) - mean(others.x)))
"""


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "hold(k*(sample(a.x) - mean(others.x)))",
            "k*(sample(a.x) - mean(others.x))",
            "6:5: E505 Pad.a.f acts on what it is joined to at all times, and is on clock clock. "
            "Write: a.f = hold(k*(sample(a.x) - mean(others.x)))",
        ),
        (
            "hold(k*",
            "hold((if role == clients then 2 else 1)*k*",
            "6:28: E206 role has no option clients; the nearest is client. Write: client",
        ),
        (
            "- a.f = hold(k*(sample(a.x) - mean(others.x)))",
            "- a.f = k*s\n  - der(s) = (a.x - mean(others.x))/time\nvariables: {s: {unit: m, start: 0}}",
            "7:5: E505 in `der(Pad.s) = (Pad.a.x - mean(others.Pad.x))/time` of Pad, mean(others.Pad.x) is "
            "on clock clock and the rest is continuous. Write: hold(mean(others.Pad.x))",
        ),
    ],
)
def test_a_component_that_hears_is_told_one_mistake_and_the_line_to_write(
    old: str, new: str, told: str, tmp_path: Path
) -> None:
    path = tmp_path / "pad.yaml"
    assert old in HEARING
    path.write_text(HEARING.replace(old, new, 1))
    with pytest.raises(ApcError) as caught:
        check_definition(path)
    assert [str(mistake).partition("\n")[0] for mistake in caught.value.mistakes] == [f"{path}:{told}"]


def test_a_component_is_checked_by_itself_and_is_no_topology(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "pad.yaml"
    path.write_text(FAULTS)
    assert run(["check", str(path)]) == 1
    assert (
        "4:16: E203 e wants a mapping of keys to values, got N. Write: e: {unit: N}"
        in capsys.readouterr().err
    )
    good = "component: Pad\nconnectors: {flange: Flange}\nequations: [flange.f = 0]\n"
    path.write_text(good)
    assert run(["check", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}: no mistakes. Pad, a component.\n"
    assert run(["analyze", str(path)]) == 1
    err = capsys.readouterr().err
    assert err.count("E201") == 1
    assert "Pad is a component; a topology has parts of its type, and names the folder it is in." in err


def test_check_refuses_what_compile_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(AVERAGE.replace("network: 8 ms", "network: 7.777777777 ms"))
    told = []
    for command in ("check", "compile"):
        assert run([command, str(path)]) == 1
        told.append(capsys.readouterr().err)
    assert told[0] == told[1]
    assert "E805 all clocks stand as before only after" in told[0]


DEAF = """
topology: deaf
clocks: {haptic: 1 ms, network: 8 ms}
peers: {user: {count: 3}}
masses: {cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}}
couplers: {coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}}
links:
  lan: {clock: network, delay: 8 ms, graph: {arcs: [[1, 2], [2, 1]]}}
"""


def test_a_peer_that_hears_nobody_is_told_where_the_link_stands() -> None:
    assert told_of(compiled, DEAF) == [
        "scene.yaml:8:3: E801 user[3] hears nobody over lan: there is no mean over nobody."
        " Write: an arc to user[3] in its graph"
    ]
    assert not told_of(compiled, replaced(DEAF, ("[2, 1]]", "[2, 1], [1, 3]]")))
    assert not told_of(compiled, replaced(DEAF, ("AveragePosition", "FullMesh")))  # a sum over nobody is 0


@pytest.mark.parametrize(
    ("part", "sentence"),
    [
        (
            "{type: RampForce, flange: cube, force: 1 N, rise: 1}",
            "rise wants s, got 1 (no unit). Write: rise: 1 s",
        ),
        (
            "{type: StepForce, flange: cube, force: 1 N, start: 2}",
            "start wants s, got 2 (no unit). Write: start: 2 s",
        ),
    ],
)
def test_the_unit_to_write_is_that_of_the_parameter(part: str, sentence: str) -> None:
    [line] = told_of(compiled, f"{DEAF}hands: {{push: {part}}}\n")
    assert line.partition("E204 ")[2] == sentence


def test_wave_variables_are_for_two_peers(tmp_path: Path) -> None:
    waves = (SCENES / "two-users-waves.yaml").read_text(encoding="utf-8")
    [line] = told_of(compiled, replaced(waves, ("count: 2", "count: 3")))
    assert line.partition("E208 ")[2] == (
        "coordination (WaveCoupling) wants 2 peers, got 3."
        " Write: count: 2, or groups that make 2: at: [left, right]"
    )
    count = next(one for one in compiled(waves).parameters if one.name == "user.count")
    assert (count.minimum, count.maximum) == (1.0, 2.0)
    own = "component: Own\npeers: 1\nconnectors: {a: Flange}\nequations: [a.f = 0]\n"
    text = replaced(DEAF, ("type: AveragePosition, object: cube, stiffness: 500 N/m", "type: Own, a: cube"))
    assert told_of(compiled, text, library(tmp_path, own))[0].partition("E203 ")[2] == (
        "peers wants a whole number from 2 on, got 1. Write: peers: 2"
    )


def test_a_component_is_told_of_before_the_files_beside_it(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "empty.yaml").write_text("", encoding="utf-8")
    (tmp_path / "own.yaml").write_text(
        "component: Own\nconnectors: {a: Flange}\nequations: [a.f = b.x]\n", encoding="utf-8"
    )
    assert run(["check", str(tmp_path / "own.yaml")]) == 1
    lines = [one for one in capsys.readouterr().err.splitlines() if one.startswith(str(tmp_path))]
    assert [re.search(r"E\d+", one)[0] for one in lines] == ["E303", "E219"]  # type: ignore[index] # both have one


# What stands in the first scene, what a user writes instead, the code and place of the one message, and what
# a number is then by each line that it says to write.
HARMLESS = [
    ("mass: 0.1 kg", "mass: 0,1 kg", "9:18: E203", {"mass: 0.1 kg": ("device.mass", 0.1)}),
    ("haptic: 1 ms", "haptic: 0,5 ms", "4:11: E221", {"haptic: 0.5 ms": ("haptic.period", 0.0005)}),
    ("1000 N/m", "1,500 N/m", "12:76: E203",
     {"stiffness: 1.500 N/m": ("contact.stiffness", 1.5),
      "stiffness: 1500 N/m": ("contact.stiffness", 1500.0)}),
    ("1000 N/m", "5 N/mm^2", "12:76: E204", {"stiffness: 5 N/mm": ("contact.stiffness", 5000.0)}),
    ("1000 N/m", "5 N/m^2", "12:76: E204", {"stiffness: 5 N/m": ("contact.stiffness", 5.0)}),
    ("1000 N/m", "5 kJ", "12:76: E204", {}),
    ("1000 N/m", "1 000 N/m", "12:76: E221", {"stiffness: 1000 N/m": ("contact.stiffness", 1000.0)}),
    ("1000 N/m", "12'500.5 N/m", "12:76: E221", {"stiffness: 12500.5 N/m": ("contact.stiffness", 12500.5)}),
    ("1000 N/m", "2*pi*100 N/m", "12:76: E204",
     {"stiffness: 628.318531 N/m": ("contact.stiffness", 628.318531)}),
    ("1000 N/m", "(1 + 2)/4 kN/m", "12:76: E204", {"stiffness: 0.75 kN/m": ("contact.stiffness", 750.0)}),
    ("1000 N/m", "1000", "12:76: E204", {"stiffness: 1000 N/m": ("contact.stiffness", 1000.0)}),
    ("mass: 0.1 kg", "mass: 100 gr", "9:22: E223", {"g": ("device.mass", 0.1)}),
    ("mass: 0.1 kg", "mass: 0.1 Kg", "9:22: E223", {"kg": ("device.mass", 0.1)}),
    ("damping: 5 N*s/m}\n  cube", "damping: 5 Ns/m}\n  cube", "9:37: E223", {"N*s": ("device.damping", 5.0)}),
    ("haptic: 1 ms", "haptic: 1000", "4:11: E204",
     {"haptic: 1000 Hz": ("haptic.period", 0.001), "haptic: 1000 ms": ("haptic.period", 1.0)}),
    ("haptic: 1 ms", "haptic: 2", "4:11: E204",
     {"haptic: 2 ms": ("haptic.period", 0.002), "haptic: 2 Hz": ("haptic.period", 0.5)}),
    ("haptic: 1 ms", "haptic: 1 m", "4:11: E204", {"haptic: 1 ms": ("haptic.period", 0.001)}),
    ("haptic: 1 ms", "haptic: 8 Ms", "4:13: E223", {"ms": ("haptic.period", 0.008)}),
    ("haptic: 1 ms", "haptic 1 ms", "4:3: E109", {"haptic: 1 ms": ("haptic.period", 0.001)}),
    ("haptic: 1 ms", "haptic 1 ms    # forces", "4:3: E109", {"haptic: 1 ms": ("haptic.period", 0.001)}),
    ("network: 8 ms", "network 8 ms", "5:3: E109", {"network: 8 ms": ("network.period", 0.008)}),
    ("haptic: 1 ms", "haptic = 1 ms", "4:3: E109", {"haptic: 1 ms": ("haptic.period", 0.001)}),
    ("haptic: 1 ms", "haptic:1 ms", "4:3: E109", {"haptic: 1 ms": ("haptic.period", 0.001)}),
    ("count: 3", "count 3", "7:10: E109", {"count: 3": ("user.count", 3.0)}),
    ("  device: {", "  - device: {", "9:3: E109",
     {"device: {mass: 0.1 kg, damping: 5 N*s/m}": ("device.mass", 0.1)}),
    ("  cube:   {", "  - cube: {", "10:3: E109",
     {"cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}": ("cube.mass", 0.6)}),
    ("  device: {", "  device {", "9:3: E109",
     {"device: {mass: 0.1 kg, damping: 5 N*s/m}": ("device.mass", 0.1)}),
    ("peers:", "users:", "6:1: E202", {"peers": ("user.count", 3.0)}),
    ("lan: {clock: network, ", "lan: {", "15:3: E201", {"clock: network": ("network.period", 0.008)}),
    ("b: cube, ", "b: device, ", "12:3: E210", {}),
    ("links:", "hands: {arm: {flange: device, stiffness: 9 N/m, damping: 1 N*s/m}}\nlinks:", "14:9: E201",
     {"type: SpringDamperArm": ("arm.stiffness", 9.0)}),
    ("links:", "hands: {arm: {flange: device, force: 2 N}}\nlinks:", "14:9: E201",
     {"type: ConstantForce": ("arm.force", 2.0)}),
]  # fmt: skip


def _written(text: str, place: str, hint: str) -> str:
    """Return a text with a line that is proposed in the place of what stands there: nothing is weighed."""
    lines = text.splitlines()
    row, column = (int(one) - 1 for one in place.split(":")[:2])
    line, key = lines[row], hint.partition(": ")[0]
    entry = re.compile(rf"(?<!\w){re.escape(key)}: (?:[^,}}\s]|(?<!\}}) (?!#))*(,\d[^,}}]*)?")
    if "E109" in place:
        rest = line[column:].partition("  #")[0]
        rest = rest if "{" in rest or "{" not in line[:column] else re.split("[,}]", rest)[0]
        lines[row] = line.replace(rest.rstrip(), hint, 1)
    elif ": " not in hint:  # a word, or a unit
        lines[row] = line[:column] + re.sub(r"[\w]+", hint, line[column:], count=1)
    elif entry.search(line):
        lines[row] = entry.sub(hint, line, count=1)
    else:
        lines[row] = line[:column] + line[column:].replace("{", f"{{{hint}, ", 1)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("old", "new", "place", "lines"), HARMLESS)
def test_each_line_that_is_proposed_is_accepted_and_means_what_was_meant(
    old: str, new: str, place: str, lines: dict[str, tuple[str, float]], tmp_path: Path, monkeypatch: Any
) -> None:
    wrong = replaced(AVERAGE, (old, new))
    [told_line] = told(tmp_path, monkeypatch, {"scene.yaml": wrong})
    first = told_line.splitlines()[0]
    assert first.startswith(f"scene.yaml:{place} ")
    hint = first.partition("Write: ")[2]
    assert hint.split(", or ") == (list(lines) or [""])
    for line, (name, number) in lines.items():
        found = compiled(_written(wrong, place, line))
        known = {one.name: float(one.number) for one in (*found.parameters, *found.timings)}
        assert known[name] == number


def test_a_value_for_one_peer_is_told_as_a_list(tmp_path: Path) -> None:
    line = told_of(parse_override, compiled(AVERAGE), "user[2].device.x=10 mm")[0]
    hint = line.partition("Write: ")[2]
    assert hint == "peers: {user: {count: 3, set: {device.x: [0 m, 10 mm, 0 m]}}}"
    found = compiled(replaced(AVERAGE, ("peers:\n  user: {count: 3}", hint)))
    assert [column.values.tolist() for column in found.groups[0].columns] == [[0.0, 0.01, 0.0]]
    many = compiled(replaced(AVERAGE, ("count: 3", "count: 30")))
    assert "table: users.csv" in told_of(parse_override, many, "user[2].device.x=10 mm")[0]


def test_clocks_that_do_not_come_together_are_told_at_the_odd_one() -> None:
    text = replaced(AVERAGE, ("haptic: 1 ms", "haptic: 1.0001 ms"))
    [line] = told_of(lambda: analyze(compiled(text)))
    assert line.startswith("scene.yaml:4:11: E805 ")


UNHELD = """\
component: Unheld
connectors: {a: Flange}
parameters: {k: {unit: N/m}, clock: clock}
equations: [a.f = k*sample(a.x)]
"""


def test_a_fault_of_a_component_is_told_once_however_many_parts_and_groups_have_it(tmp_path: Path) -> None:
    text = replaced(
        AVERAGE,
        ("user: {count: 3}", "left: {count: 2, set: {contact.delay: 2 ms}}\n  right: {count: 1}"),
        (
            "couplers:\n",
            "couplers:\n  one: {type: Unheld, a: device, k: 1 N/m, clock: haptic}\n"
            "  two: {type: Unheld, a: cube, k: 1 N/m, clock: haptic}\n",
        ),
    )
    [line] = told_of(lambda: compiled(text, library(tmp_path, UNHELD)))
    assert "E505 one.a.f acts on what it is joined to at all times" in line


def test_what_is_left_out_of_a_part_is_told_once_with_all_that_is_to_be_written() -> None:
    text = replaced(
        AVERAGE,
        ("type: SampledSpringDamper, a: device, b: cube, ", "type: VirtualWall, "),
        ("stiffness: 1000 N/m, clock: haptic, delay: 1 ms", ""),
    )
    first, *others = [line for line in told_of(compiled, text) if "E201" in line]
    assert not others
    hint = first.partition("Write: ")[2]
    assert "has no stiffness" in first
    assert hint.count(": ") > 1
    assert not [
        line
        for line in told_of(
            compiled, replaced(text, ("VirtualWall, ", f"VirtualWall, flange: device, {hint}"))
        )
        if "studies" not in line
    ]


def test_all_who_hear_nobody_are_told_at_once() -> None:
    text = replaced(DEAF, ("user: {count: 3}", "near: {count: 2}, far: {count: 2}"))
    [line] = told_of(compiled, text)
    assert line.endswith(
        "E801 far[1] and far[2] hear nobody over lan: there is no mean over nobody. "
        "Write: an arc to each in its graph, or at: [near] in what uses lan"
    )
    assert not told_of(compiled, replaced(text, ("link: lan}}", "link: lan, at: [near]}}")))
