"""Hands that nobody has built: random trees of links and joints as URDF texts, an MJCF file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

WEDGE = np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0, 0, 0.03]])
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
DAE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><library_geometries>
<geometry id="g"><mesh><source id="p"><float_array id="a" count="12">{numbers}</float_array></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>{indices}</p></triangles></mesh></geometry>
</library_geometries></COLLADA>"""
MJCF = """<mujoco model="tri"><compiler angle="degree" eulerseq="zyx"/>
<default><geom type="capsule"/><default class="f"><joint axis="0 1 0" range="-10 90"/><geom size="0.01 0.02"/>
<default class="v"><geom contype="0" conaffinity="0"/></default></default></default>
<asset><mesh name="t" vertex="0 0 0 .02 0 0 0 .02 0 0 0 .03" scale="1 -1 1"/><mesh name="w" file="wedge.obj"/></asset>
<worldbody><geom type="plane" size="1 1 .1"/>
<body name="palm" pos="1 2 3" euler="10 20 30" childclass="f"><freejoint/><geom type="box" size=".04 .04 .01"/>
  <body name="a" pos="0.04 0 0.01" euler="10 -20 30">
    <joint name="j1" pos="0 0 .01" ref="15"/><joint name="j2" axis="1 0 1" range="-5 60"/>
    <geom fromto="0 0 0 0 0 .05" size=".01"/>
    <body name="a2" pos="0 0 .05" axisangle="1 1 0 30"><joint name="j3"/><geom pos="0 0 .02"/>
      <geom class="v" type="mesh" mesh="t"/>
      <body name="tip" pos="0 0 .04" zaxis="1 0 1"><inertial pos="0 0 0" mass=".01" diaginertia="1e-5 1e-5 1e-5"/>
        <geom type="ellipsoid" size=".01 .02 .01"/></body></body></body>
  <body name="b" pos="-0.04 0 0.01" xyaxes="0 1 0 -1 0 0">
    <joint name="s1" type="slide" range="0 .05" ref=".01" axis="1 1 0"/><geom type="mesh" mesh="t"/>
    <body name="b2" pos="0 0 .05" quat="1 2 0 0"><joint name="k" pos=".01 0 0" range="-80 100" ref="5"/>
      <geom type="mesh" mesh="w" pos="0 0 .02"/></body></body>
</body></worldbody>
<equality><joint joint1="k" joint2="j3" polycoef="0.1 .5 0 0 0"/></equality>
<actuator><position joint="j1" forcerange="-2 2" kp="1"/><motor joint="s1" ctrlrange="0 5" gear="3"/></actuator>
</mujoco>"""
GEOMETRIES = (
    '<box size="0.02 0.03 0.04"/>',
    '<sphere radius="0.012"/>',
    '<cylinder radius="0.01" length="0.04"/>',
    '<capsule radius="0.01" length="0.03"/>',
    '<mesh filename="wedge.obj"/>',
    '<mesh filename="package://zoo/wedge.stl" scale="-1 1 0.5"/>',
    '<mesh filename="wedge.dae" scale="2 2 2"/>',
)


_numbers = st.floats(-0.08, 0.08).map(lambda x: round(x, 4))
_angles = st.floats(-3.1, 3.1).map(lambda x: round(x, 3))


def _triple(values: st.SearchStrategy[float]) -> st.SearchStrategy[str]:
    return st.tuples(values, values, values).map(lambda t: " ".join(map(repr, t)))


@st.composite
def urdfs(draw: st.DrawFn) -> tuple[str, dict[str, tuple[str, float, float]]]:
    """A URDF with at least one actuated joint, and its couplings by joint: leader, multiplier, offset."""
    count = draw(st.integers(2, 7))
    links = "".join(_link(draw, i) for i in range(count))
    joints, moving, couplings = [], [], {}
    for child in range(1, count):
        kinds = ["revolute", "continuous", "prismatic"] + (["fixed"] if moving or child < count - 1 else [])
        kind = draw(st.sampled_from(kinds))
        name, extra = f"joint_{child}", ""
        if kind != "fixed":
            axis = draw(_triple(st.sampled_from([-1.0, 0.0, 0.5, 2.0])).filter(lambda text: text != "0.0 0.0 0.0"))
            extra = f'<axis xyz="{axis}"/>'
            if kind != "continuous":
                lower, width = draw(_numbers), draw(st.floats(0.01, 1.0))
                extra += f'<limit lower="{lower}" upper="{lower + width}" effort="{draw(st.sampled_from([0, 3]))}"/>'
            if moving and draw(st.booleans()):
                leader, factor = draw(st.sampled_from(moving)), draw(st.sampled_from([-1.0, 0.5, 1.3]))
                couplings[name] = (leader, factor, draw(_numbers))
                extra += f'<mimic joint="{leader}" multiplier="{factor}" offset="{couplings[name][2]}"/>'
            moving.append(name)
        parent = draw(st.integers(0, child - 1))
        joints.append(
            f'<joint name="{name}" type="{kind}"><parent link="link_{parent}"/><child link="link_{child}"/>'
            f'<origin xyz="{draw(_triple(_numbers))}" rpy="{draw(_triple(_angles))}"/>{extra}</joint>'
        )
    if not moving:
        joints[-1] = joints[-1].replace('type="fixed"', 'type="continuous"')
    order = draw(st.permutations(joints))
    return f'<robot name="zoo">{links}{"".join(order)}</robot>', couplings


def _link(draw: st.DrawFn, number: int) -> str:
    tag = draw(st.sampled_from(["collision", "visual", ""]))
    shape = draw(st.sampled_from(GEOMETRIES))
    origin = f'<origin xyz="{draw(_triple(_numbers))}" rpy="{draw(_triple(_angles))}"/>'
    # The first link always has a shape, because a hand without any is refused.
    tag = tag or ("collision" if number == 0 else "")
    body = f"<{tag}>{origin}<geometry>{shape}</geometry></{tag}>" if tag else ""
    return f'<link name="link_{number}">{body}</link>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package with the wedge as obj, stl and dae."""
    folder = tmp_path_factory.mktemp("zoo")
    (folder / "package.xml").write_text("<package><name>zoo</name></package>")
    faces = "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES)
    (folder / "wedge.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in WEDGE) + faces)
    loops = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*WEDGE[i]) for i in face)
        + "endloop\nendfacet\n"
        for face in FACES
    )
    (folder / "wedge.stl").write_text(f"solid wedge\n{loops}endsolid wedge\n")
    numbers, indices = " ".join(map(str, WEDGE.ravel())), " ".join(str(i) for face in FACES for i in face)
    (folder / "wedge.dae").write_text(DAE.format(numbers=numbers, indices=indices))
    return folder


@pytest.fixture(scope="session")
def mjcf() -> str:
    """An MJCF file with most of what is read of the format."""
    return MJCF


@pytest.fixture(scope="session")
def trees() -> st.SearchStrategy[tuple[str, dict[str, tuple[str, float, float]]]]:
    """URDFs with at least one actuated joint, and their couplings."""
    return urdfs()
