"""Variants of a small bench, one for each element and value of an attribute that MuJoCo's own XML schema lists.

A variant is the bench plus an element and what that needs, or that plus one attribute; MuJoCo says what compiles. The
values of an attribute are the keywords that MuJoCo takes there, those of `VALUES`, or the first numbers that fit.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.image import imsave

LINK = '<geom name="{}" type="capsule" size=".02 .1" pos="0 0 -.1"/>'
MORE = {1: "", 2: f'<body name="fore" pos="0 0 -.2"><joint name="k" axis="0 1 0"/>{LINK.format("a")}</body>'}
BENCH = """<mujoco><worldbody><site name="w" pos=".1 0 0"/>
  <body name="arm"><joint name="j" axis="0 1 0"/>{link}<site name="s" pos="0 0 -.2"/>{more}</body>
  </worldbody></mujoco>"""


@cache
def read_schema() -> dict[str, tuple[str, ...]]:
    """The attributes of each element, by its path below <mujoco>."""
    found: dict[str, list[str]] = {}
    path: list[str] = []
    for line in mujoco.mj_printSchema(False, False).splitlines():
        if named := re.match(r"( *)(\S+) \(.\) *(.*)", line):
            depth = len(named[1]) // 3
            path = [*path[:depth], named[2].replace("(world)", "")]
            found["/".join(path[1:])] = named[3].split()
        elif line.strip():
            found["/".join(path[1:])] += line.split()
    return {place: tuple(attributes) for place, attributes in found.items() if place}


def plain(sections: str) -> str:
    """Without the mark."""
    return sections.replace('here=""', "")


# What elements need around them: sections of an MJCF, <arm> for the inside of the moving body; here="" marks the
# element itself, which may also be one of the bench.
GROUND = '<worldbody><geom name="ground" type="plane" size="1 1 .1" pos="0 0 -.2"/></worldbody>'
TENDON = (
    '<tendon><spatial name="t" here=""><site site="w"/><site site="s"/></spatial></tendon>'
    '<tendon><fixed name="t2"><joint joint="j" coef="1"/></fixed></tendon>'
)
MESH = '<asset><mesh name="m" here="" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>'
OF_MESH = '<arm><geom type="mesh" mesh="m" pos="0 0 -.1"/></arm>'
TEXTURE = '<asset><texture name="x" here="" type="2d" builtin="checker" width="8" height="8"/></asset>'
MATERIAL = '<asset><material name="y" here=""/></asset><arm><geom size=".01" material="y" pos="0 0 -.1"/></arm>'
CUBE = ".1 .1 .1 -.1 .1 .1 .1 -.1 .1 .1 .1 -.1"
SKIN = (
    f'<skin name="k" here="" vertex="{CUBE}" face="0 1 2"><bone body="arm" bindpos="0 0 0" bindquat="1 0 0 0" '
    'vertid="0 1 2 3" vertweight="1 1 1 1"/></skin>'
)
FLEX = (
    '<deformable><flex name="f" dim="1" body="world arm" vertex=".1 0 0 0 0 -.2" element="0 1" here=""><edge '
    'stiffness="5"/></flex></deformable>'
)
FLEXCOMP = (
    '<arm><flexcomp name="c" type="grid" dim="2" count="3 3 1" spacing=".02 .02 .02" rigid="true" here="">{}'
    "</flexcomp></arm>"
)
COMPOSITE = (
    '<arm><composite prefix="c" type="cable" curve="s" count="4 1 1" size=".2" offset="0 0 -.2" initial="none" here="">'
    '<geom type="capsule" size=".01"/>{}</composite></arm>'
)
PLUGIN = (
    '<extension><plugin plugin="{0}"><instance name="i"><config key="{1}" value="{2}"/>{3}</instance></plugin>'
    "</extension>"
)
PID = PLUGIN.format("mujoco.pid", "kp", "2", "")
CABLE = PLUGIN.format("mujoco.elasticity.cable", "twist", "1e4", "")
OF_CABLE = '<arm><plugin instance="i"/></arm>'
SDF = PLUGIN.format("mujoco.sdf.torus", "radius1", ".05", "")
TOUCH = PLUGIN.format(
    "mujoco.sensor.touch_grid", "size", "2 2", '<config key="fov" value="10 10"/><config key="gamma" value="0"/>'
)
RECIPES = {
    "asset/mesh": MESH + OF_MESH,
    "asset/mesh/plugin": SDF + '<asset><mesh name="m"><plugin here="" instance="i"/></mesh></asset>' + OF_MESH,
    "asset/hfield": '<asset><hfield name="h" here="" nrow="2" ncol="2" elevation="0 1 1 0" size="1 1 .1 .1"/></asset>'
    '<worldbody><geom type="hfield" hfield="h" pos="0 0 -.3"/></worldbody>',
    "asset/skin": f"<asset>{SKIN}</asset>",
    "asset/texture": TEXTURE,
    "asset/material": MATERIAL + plain(TEXTURE),
    "asset/material/layer": plain(TEXTURE)
    + '<asset><material name="y"><layer here="" role="rgb" texture="x"/></material></asset>',
    "asset/model": '<asset><model name="part" file="part.xml" here=""/></asset>'
    '<arm><attach model="part" body="b" prefix="p"/></arm>',
    "body/attach": '<asset><model name="part" file="part.xml"/></asset>'
    '<arm><attach model="part" body="b" prefix="p" here=""/></arm>',
    "body/inertial": '<arm><inertial pos="0 0 -.1" mass=".3" diaginertia=".002 .002 .001" here=""/></arm>',
    "body/freejoint": '<worldbody><body name="loose"><freejoint here=""/><geom size=".02"/></body></worldbody>',
    "body/geom": GROUND,
    "body/camera": '<arm><camera name="c" here=""/></arm>',
    "body/light": '<arm><light name="l" here=""/></arm>',
    "body/geom/plugin": SDF
    + plain(MESH)
    + '<arm><geom type="sdf" mesh="m"><plugin instance="i" here=""/></geom></arm>',
    "body/plugin": CABLE + '<arm><plugin instance="i" here=""/></arm>',
    "body/plugin/config": '<extension><plugin plugin="mujoco.elasticity.cable"/></extension><arm><plugin '
    'plugin="mujoco.elasticity.cable"><config key="twist" value="1e4" here=""/></plugin></arm>',
    "actuator/plugin/config": '<extension><plugin plugin="mujoco.pid"/></extension><actuator><plugin '
    'plugin="mujoco.pid" site="s"><config key="kp" value="2" here=""/></plugin></actuator>',
    "body/composite": COMPOSITE.format(""),
    "body/composite/joint": plain(COMPOSITE).format('<joint kind="main" here=""/>'),
    "body/composite/plugin": '<extension><plugin plugin="mujoco.elasticity.cable"/></extension>'
    + plain(COMPOSITE).format('<plugin plugin="mujoco.elasticity.cable" here=""/>'),
    "body/composite/geom": plain(COMPOSITE).replace("<geom", '<geom here=""').format(""),
    "body/flexcomp": FLEXCOMP.format(""),
    "deformable/flex": FLEX,
    "deformable/skin": f"<deformable>{SKIN}</deformable>",
    "contact/pair": GROUND + '<contact><pair geom1="a" geom2="ground" here=""/></contact>',
    "contact/exclude": GROUND + '<contact><exclude body1="arm" body2="world" here=""/></contact>',
    "tendon/spatial": TENDON,
    "tendon/fixed": '<tendon><fixed name="t" here=""><joint joint="j" coef="1"/></fixed></tendon>',
    "tendon/fixed/joint": '<tendon><fixed name="t" stiffness="3"><joint joint="j" coef="1" here=""/></fixed></tendon>',
    "tendon/spatial/site": '<tendon><spatial stiffness="3"><site site="w"/><site site="s" here=""/></spatial></tendon>',
    "tendon/spatial/geom": '<arm><geom name="g" size=".01" pos="0 0 -.1"/><site name="side" pos=".05 0 -.1"/></arm>'
    '<tendon><spatial stiffness="3"><site site="w"/><geom geom="g" here=""/><site site="s"/></spatial></tendon>',
    "tendon/spatial/pulley": '<tendon><spatial stiffness="3"><site site="w"/><site site="s"/><pulley divisor="2" '
    'here=""/><site site="w"/><site site="s"/></spatial></tendon>',
    "equality/connect": '<equality><connect body1="arm" body2="world" anchor="0 0 -.2" here=""/></equality>',
    "equality/weld": '<equality><weld body1="arm" body2="world" here=""/></equality>',
    "equality/joint": '<equality><joint joint1="j" here=""/></equality>',
    "equality/tendon": plain(TENDON) + '<equality><tendon tendon1="t" here=""/></equality>',
    "equality/flex": plain(FLEX) + '<equality><flex flex="f" here=""/></equality>',
    "equality/flexvert": plain(FLEX) + '<equality><flexvert flex="f" here=""/></equality>',
    "equality/flexstrain": plain(FLEX) + '<equality><flexstrain flex="f" here=""/></equality>',
    "actuator/plugin": PID + '<actuator><plugin plugin="mujoco.pid" instance="i" site="s" here=""/></actuator>',
    "actuator/adhesion": GROUND + '<actuator><adhesion body="arm" ctrlrange="0 1" here=""/></actuator>',
    "actuator/muscle": plain(TENDON) + '<actuator><muscle name="u" tendon="t" lengthrange=".1 .5" here=""/></actuator>',
    "actuator/damper": '<actuator><damper name="u" site="s" ctrlrange="0 1" here=""/></actuator>',
    "actuator/dcmotor": '<actuator><dcmotor name="u" site="s" motorconst=".1" resistance="2" here=""/></actuator>',
    "sensor/plugin": TOUCH + '<sensor><plugin objtype="site" objname="s" instance="i" here=""/></sensor>',
    "sensor/user": '<sensor><user dim="1" here=""/></sensor>',
    "sensor/tactile": plain(MESH) + '<sensor><tactile geom="a" mesh="m" here=""/></sensor>',
    "sensor/insidesite": '<sensor><insidesite objtype="body" objname="arm" site="s" here=""/></sensor>',
    "extension/plugin": '<extension><plugin plugin="mujoco.pid" here=""/></extension>',
    "extension/plugin/instance": CABLE.replace("<instance", '<instance here=""') + OF_CABLE,
    "extension/plugin/instance/config": CABLE.replace("<config", '<config here=""') + OF_CABLE,
    "custom/numeric": '<custom><numeric name="n" data="1 2" here=""/></custom>',
    "custom/text": '<custom><text name="n" data="some" here=""/></custom>',
    "custom/tuple": '<custom><tuple name="n" here=""><element objtype="body" objname="arm"/></tuple></custom>',
    "custom/tuple/element": '<custom><tuple name="n"><element objtype="body" objname="arm" here=""/></tuple></custom>',
    "keyframe/key": '<worldbody><body name="mocap" mocap="true"/></worldbody><keyframe><key here=""/></keyframe>',
}
for name in ("edge", "elasticity", "contact", "pin"):
    inner, edged = f'<{name} here=""/>', plain(FLEX)
    RECIPES[f"body/flexcomp/{name}"] = plain(FLEXCOMP).format(inner)
    RECIPES[f"deformable/flex/{name}"] = edged.replace(
        "<edge ", '<edge here="" ' if name == "edge" else f"{inner}<edge "
    )
for name in ("skin", "site"):
    RECIPES[f"body/composite/{name}"] = plain(COMPOSITE).format(f'<{name} here=""/>')
for name in ("motor", "general", "position", "velocity", "intvelocity", "pid", "cylinder", "orientation"):
    RECIPES[f"actuator/{name}"] = f'<actuator><{name} name="u" site="s" ctrlrange="-1 1" here=""/></actuator>'
BONE = plain(SKIN).replace("<bone", '<bone here=""')
RECIPES["asset/skin/bone"], RECIPES["deformable/skin/bone"] = (
    f"<asset>{BONE}</asset>",
    f"<deformable>{BONE}</deformable>",
)
EXISTING = {"body": ".//body[@name='arm']", "body/joint": ".//joint[@name='j']", "body/geom": ".//geom[@name='a']"}
EXISTING["body/site"] = ".//site[@name='s']"
# What a default acts on, where the bench has none; an actuator's act on the one that the bench gets.
USERS = {
    **{"mesh": "asset/mesh", "texture": "asset/texture", "material": "asset/material", "geom": "body/geom"},
    **{"material/layer": "asset/material/layer", "camera": "body/camera", "light": "body/light"},
    **{"pair": "contact/pair", "equality": "equality/connect", "tendon": "tendon/spatial"},
}

CRASHING = "body/flexcomp/plugin"  # MuJoCo 3.17 ends with a segmentation fault

KEYWORDS = re.findall(
    r"\S+",
    """true false auto enable disable local global degree radian Euler RK4 implicit implicitfast discrete
pyramidal elliptic dense sparse PGS CG Newton none muscle muscleuser all fixed track trackcom targetbody targetbodycom
hinge slide ball free plane hfield sphere capsule ellipsoid cylinder box mesh sdf 2d cube skybox gradient checker flat
edge cross random linear sRGB spot directional point image integrator filter filterexact dcmotor user affine zoh cubic
convex exact legacy shell main near curve body xbody geom site camera joint tendon pos vel acc real positive axis
quaternion perspective orthographic depth distance normal segmentation rgb rgba orm occlusion opacity roughness metallic
emissive found force torque dist tangent mindist maxforce netforce grid square circle disc line cable particle loop rope
cloth vert bvh sap narrow full radial trilinear quadratic warning merge error allowed never init young bend stretch both
hemisphere cone supersphere supertorus torus plate wedge prism simple similar position velocity voltage current strain
""",
)


def _list_values(text: str) -> dict[str, tuple[str, ...]]:
    """Read `NAME: VALUE | VALUE; NAME: ...`."""
    entries = (entry.split(": ") for entry in " ".join(text.split()).split("; "))
    return {name: tuple(values.split(" | ")) for name, values in entries}


VALUES = {"vertex": (f"0 0 0 {CUBE}",)} | _list_values(  # where the first numbers that fit would be out of place
    """
name: new | m | h | part; class: main; childclass: main; user: 1; group: 2; joint: j; jointinparent: j; tendon: t;
body: arm | b; site: s; refsite: w; cranksite: w; slidersite: s; geom: a; camera: c; actuator: u; mesh: m; joint1: j;
joint2: k | j; tendon1: t; tendon2: t2; target: arm; body1: arm | world; body2: world | fore; geom1: a;
geom2: ground | a; site1: s; site2: w; subtree1: arm; subtree2: world; flex: f; objname: arm; refname: w;
reftype: site; material: y; texture: x; hfield: h; plugin: mujoco.pid; instance: i; key: ki | twist; value: 3;
sidesite: side; file: cube.obj | cells.png | part.xml; eulerseq: zyx | XYZ; meshdir: parts; assetdir: parts;
texturedir: parts; model: part; frame: fr; maxhullvert: 10; prefix: q; gravity: 0 1 -5; timestep: 0.001 | 0.004;
actuatorgroupdisable: 0 | 2; wind: 1 2 0; density: 100; viscosity: .5; iterations: 1 | 50; tolerance: 1e-4 | 0;
ls_iterations: 2; noslip_iterations: 3; impratio: 10; settotalmass: 2; boundmass: .5; boundinertia: .01;
inertiagrouprange: 0 1 | 1 2; ref: 20; damping: .3 | .3 .2 .1; stiffness: 3 | 3 2 1; springdamper: .2 1;
springref: 20; solref: .01 1 | .05 .5 | -200 -5; solreflimit: .01 1 | -200 -5; solreffriction: .01 1;
solimp: .8 .9 .01 .4 3; solimplimit: .8 .9 .01 .4 3; solimpfriction: .8 .9 .01 .4 3; o_solref: .01 1;
o_solimp: .8 .9 .01 .4 3; o_friction: .5 .5 .01 .001 .001; o_margin: .03; margin: .03 | .002; gap: .01;
pos: 0 .01 -.03; axis: .1 1 .3; range: -30 40 | -.1 .2 | .1 .25; quat: 1 .2 .1 0; axisangle: 1 0 0 20;
xyaxes: 1 .1 0 0 1 .2; zaxis: 0 .2 1; euler: 10 20 30; fromto: 0 0 0 .1 0 -.2; gravcomp: .5 | 1; mass: .4;
size: .03 | .03 .04 | .03 .04 .05; friction: .5 | .5 .01 .001; condim: 1 | 4 | 6; gear: 2 | 1 0 0 0 0 0;
ctrlrange: -.1 .1 | 0 .1; forcerange: -.1 .1; actuatorfrcrange: -.1 .1; gainprm: 2; biasprm: 1 -2 -.3; dynprm: .1;
springlength: .1 | .1 .15; polycoef: .1 .5 0 0 0 | 0 1 0 0 0; anchor: 0 0 -.1; relpose: 0 0 .1 1 0 0 0;
fluidcoef: 1 .5 2 1 1; fullinertia: .002 .002 .001 1e-4 0 0; diaginertia: .003 .002 .002; lengthrange: .1 .5;
qpos: .1 | .1 .2; qvel: .1 | .1 .2; data: 1 2 | force; noise: .1; delay: .004; nsample: 4; conaffinity: 0 | 2;
contype: 0 | 2; actdim: 1; objtype: body | xbody | geom | site | camera; coef: 2 | -.5;
curve: l 0 0 | cos(s) sin(s) 0; role: rgb; young: 1e4; poisson: .2; thickness: .01; count: 3 3 1 | 4 1 1; memory: 1M;
nstack: 100000; njmax: 100 | 1; nconmax: 50 | 1; cutoff: .1; radius: .03 | .005;
face: 0 2 1 0 1 3 0 3 2 1 2 3 | 0 1 2"""
)
NUMBERS = (".3", "2", ".3 .2", "2 1", ".1 .2 .3", "1 2 1", ".4 .3 .2 .1", "0 1 2 1", ".5 .4 .3 .2 .1", "1 0 0 1 0 0 0")
NUMBERS += ("true",)
TRANSMISSIONS = ("joint", "jointinparent", "tendon", "body", "site", "cranksite")
FRAMES = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
LEAVES_OUT = {  # an attribute, and those that it stands in for
    **{name: TRANSMISSIONS for name in TRANSMISSIONS if name != "site"},
    **{name: FRAMES for name in FRAMES},
    **{"file": ("vertex", "elevation", "nrow", "ncol", "builtin"), "builtin": ("vertex",), "params": ("vertex",)},
    **{"fullinertia": ("diaginertia",), "site1": ("body1", "body2", "anchor"), "site2": ("body1", "body2", "anchor")},
    **{"geom1": ("body1",), "geom2": ("body2",), "body1": ("geom1",), "subtree1": ("geom1",), "plugin": ("instance",)},
    **dict.fromkeys(("slidersite", "cranklength"), TRANSMISSIONS),
    **{"camera": ("site",), "frame": ("body",), "fromto": ("pos",), "site": TRANSMISSIONS},
}
ACTUATORS, SENSORS = (
    [place.partition("/")[2] for place in read_schema() if re.fullmatch(f"{section}/[a-z_]+", place)]
    for section in ("actuator", "sensor")
)
LENS = ("focal", "focalpixel", "principal", "principalpixel")
# Attributes without effect alone, and what they act with.
WITH = {
    **dict.fromkeys(("joint@limited", "joint@margin", "joint@solreflimit", "joint@solimplimit"), 'range="-30 40"'),
    **dict.fromkeys(("joint@springref", "joint@ref"), 'stiffness="3"'),
    **dict.fromkeys(("joint@solimpfriction", "joint@solreffriction"), 'frictionloss=".1"'),
    **{"joint@actuatorfrclimited": 'actuatorfrcrange="-.1 .1"', "joint@actuatorgravcomp": 'gravcomp="1"'},
    **dict.fromkeys(("spatial@limited", "spatial@margin", "spatial@solreflimit"), 'range=".1 .2"'),
    **dict.fromkeys(("fixed@limited", "fixed@margin", "fixed@solreflimit", "fixed@solimplimit"), 'range="-.2 .3"'),
    **{
        "spatial@solimplimit": 'range=".1 .2"',
        "spatial@springlength": 'stiffness="30"',
        "fixed@springlength": 'stiffness="3"',
    },
    **{
        **{"geom@mesh": 'type="mesh"', "site@mesh": 'type="mesh"', "geom@hfield": 'type="hfield"'},
        "mesh@params": 'builtin="sphere"',
    },
    **dict.fromkeys((f"camera@{name}" for name in LENS), 'sensorsize=".1 .1" resolution="4 4" focal=".1 .1"'),
    **dict.fromkeys((f"{name}@slidersite" for name in ACTUATORS), 'cranksite="w" cranklength=".1"'),
    **dict.fromkeys((f"{name}@cranklength" for name in ACTUATORS), 'cranksite="w" slidersite="s"'),
    **dict.fromkeys((f"{name}@cranksite" for name in ACTUATORS), 'slidersite="s" cranklength=".1"'),
    **dict.fromkeys((f"{name}@inheritrange" for name in ACTUATORS), 'joint="j"'),
    **dict.fromkeys((f"{name}@delay" for name in (*ACTUATORS, *SENSORS)), 'nsample="4"'),
    **dict.fromkeys((f"{name}@refname" for name in SENSORS), 'reftype="site"'),
    **dict.fromkeys((f"{name}@reftype" for name in SENSORS), 'refname="w"'),
    **{"mesh@builtin": 'params="2"', "user@objtype": 'objname="arm"', "user@objname": 'objtype="body"'},
    **dict.fromkeys((f"dcmotor@{name}" for name in read_schema()["default/dcmotor"]), 'motorconst=".1" resistance="2"'),
    **dict.fromkeys(("geom@fluidshape", "geom@fluidcoef"), 'fluidshape="ellipsoid"'),
    **{"camera@target": 'mode="targetbody"', "light@target": 'mode="targetbody"', "connect@site1": 'site2="w"'},
    **{"connect@site2": 'site1="s"', "weld@site1": 'site2="w"', "weld@site2": 'site1="s"', "geom@gap": 'margin=".02"'},
    **{"general@ctrllimited": 'ctrlrange="-.1 .1"', "general@forcelimited": 'forcerange="-.1 .1"'},
    **dict.fromkeys(("general@actdim", "general@dynprm", "general@actearly"), 'dyntype="integrator"'),
}
REFERRED = {  # what a sensor's references need
    "tendon": TENDON.replace('here=""', 'range=".1 .25"'),
    "actuator": '<actuator><motor name="u" site="s"/></actuator>',
    "camera": '<arm><camera name="c"/></arm>',
    "joint": '<default><joint range="-30 40"/></default>',
}
ELSEWHERE = {  # and what they need in other elements
    "fluidshape": '<option density="100"/>',
    "fluidcoef": '<option density="100"/>',
    "wind": '<option density="100"/>',
    "material": plain(MATERIAL),
    "mesh": plain(MESH),
    "hfield": '<asset><hfield name="h" nrow="2" ncol="2" elevation="0 1 1 0" size="1 1 .1 .1"/></asset>',
    "objtype": '<arm><site name="arm"/><camera name="arm"/><geom name="arm" size=".01"/></arm>',
    "camera": '<arm><camera name="c"/></arm>',
    "tendon": plain(TENDON),
    "cone": GROUND,
    "impratio": GROUND + '<option cone="elliptic"/>',
    "solver": GROUND,
    "noslip_iterations": GROUND,
    **dict.fromkeys(
        ("o_solref", "o_solimp", "o_friction", "o_margin"), GROUND + '<option><flag override="enable"/></option>'
    ),
    **dict.fromkeys(("contact", "constraint", "nativeccd", "refsafe", "multiccd", "warmstart", "island"), GROUND),
    **{"limit": '<default><joint range="-30 40"/></default>', "spring": '<default><joint stiffness="3"/></default>'},
    **{
        "damper": '<default><joint stiffness="3" damping=".2"/></default>',
        "equality": '<equality><joint joint1="j"/></equality>',
    },
    **{"eulerdamp": '<default><joint damping=".2"/></default>'},
}


SECTIONS = _list_values("tendon: actuator; camera: sensor; mesh: body | default; material: body | default")


@dataclass(frozen=True)
class Variant:
    """One model file.

    Attributes:
        name: Its place in the schema, `section/element@attribute=value` or `section/element`.
        joints: Of the bench that it is a variant of.
        text: The MJCF.
    """

    name: str
    joints: int
    text: str


def all_places() -> list[tuple[str, str | None]]:
    """Every element, and every attribute of one, that MuJoCo's compiler survives."""
    schema = {place: names for place, names in read_schema().items() if not place.startswith(CRASHING)}
    return [(place, name) for place, names in schema.items() for name in (None, *names)]


def write_files(folder: Path) -> None:
    """What the variants name as files."""
    (folder / "cube.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    part = '<frame name="fr"><body name="b"><geom size=".03" pos="0 0 -.1"/></body></frame>'
    (folder / "part.xml").write_text(f"<mujoco><worldbody>{part}</worldbody></mujoco>")
    imsave(folder / "cells.png", np.eye(4))


def variants(place: str, attribute: str | None, joints: int) -> Iterator[Variant]:
    """The variants of one place of the schema that MuJoCo compiles, the working directory being that of `write_files`.

    Args:
        place: A key of `read_schema`.
        attribute: One of its attributes, or None for the element itself.
        joints: How many the bench has.
    """

    def compiled(values: Iterable[str]) -> Iterator[Variant]:
        for value in values:
            text = _assemble(place, attribute, value, joints)
            if _fault_of(text) is None:
                yield Variant(place if attribute is None else f"{place}@{attribute}={value}", joints, text)

    if attribute is None:
        yield from compiled([""])
        return
    keyword = "invalid keyword" in (_fault_of(_assemble(place, attribute, "?", joints)) or "")
    found = list(compiled(KEYWORDS if keyword else VALUES.get(attribute, ())))
    yield from found or islice(compiled(NUMBERS), 1)


def _fault_of(text: str) -> str | None:
    """Why MuJoCo does not compile a model, or None."""
    try:
        mujoco.MjModel.from_xml_string(text)
    except (ValueError, RuntimeError) as error:  # it says so of some files: "Caught an unknown exception!"
        return str(error)
    return None


def _assemble(place: str, attribute: str | None, value: str, joints: int) -> str:
    """The bench with an element of the schema, and an attribute of it."""
    root = ET.fromstring(BENCH.format(link=LINK.format("a" if joints == 1 else "b"), more=MORE[joints]))
    section, _, rest = place.partition("/")
    if section == "default":
        user = USERS.get(rest)
        target = _add(root, user) if user else None
        if target is not None and attribute in target.attrib:
            del target.attrib[attribute]
        inside = ET.SubElement(root, "default")
        for tag in rest.split("/") if rest else ():
            inside = ET.SubElement(inside, tag)
        if not rest:
            inside = ET.SubElement(inside, "default", {"class": "other"})
    else:
        inside = _add(root, place)
    if attribute is not None:
        for other in LEAVES_OUT.get(attribute, ()):
            inside.attrib.pop(other, None)
        inside.attrib.update(re.findall(r'(\w+)="([^"]*)"', WITH.get(f"{inside.tag}@{attribute}", "")))
        if "gravcomp" in inside.attrib and inside.tag == "joint":
            root.find(".//body[@name='arm']").set("gravcomp", inside.attrib.pop("gravcomp"))
        if section in SECTIONS.get(attribute, (section,)):
            _merge(root, ELSEWHERE.get(attribute, ""))
        inside.set(attribute, value)
    if (ground := root.find(".//geom[@name='ground']")) is not None:
        ground.set("pos", f"0 0 {-0.2 * joints}")
    return ET.tostring(root, encoding="unicode")


def _add(root: ET.Element, place: str) -> ET.Element:
    """The element of this place, with all that it needs added to a bench."""
    marked = _merge(root, RECIPES.get(place, ""))
    if place in EXISTING:
        return root.find(EXISTING[place])
    if marked is not None:
        del marked.attrib["here"]
        return marked
    inside = root
    for tag in place.split("/"):
        inside = ET.SubElement(inside, tag)
    for name, referred in _references(place).items():
        inside.set(name, referred)
        _merge(root, REFERRED.get(name, ""))
    return inside


def _merge(root: ET.Element, sections: str) -> ET.Element | None:
    """Add sections to an MJCF; the element that is marked."""
    for section in ET.fromstring(f"<more>{sections}</more>"):
        into = root.find(".//body[@name='arm']") if section.tag == "arm" else root
        into.extend(list(section) if section.tag == "arm" else [section])
    return root.find(".//*[@here]")


def _references(place: str) -> dict[str, str]:
    """What a sensor looks at."""
    section, _, kind = place.partition("/")
    if section != "sensor":
        return {}
    names = read_schema()[place]
    if "objtype" in names:
        return {"objtype": "body", "objname": "arm"}
    if "geom1" in names:
        return {"geom1": "a"} | ({} if kind == "contact" else {"body2": "world"})
    known = {"site": "s", "joint": "j", "tendon": "t", "actuator": "u", "body": "arm", "camera": "c"}
    return {name: known[name] for name in names if name in known and (name, kind) != ("camera", "rangefinder")}
