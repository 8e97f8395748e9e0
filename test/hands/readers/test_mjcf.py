"""MJCF and trees at random move as in MuJoCo and are given a palm and postures; what is not read is refused by name."""
# pyright: reportAttributeAccessIssue=false

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from expected import refused
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from graspd_core import TriangleMesh, save_mesh
from graspd_core.errors import HandError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import hand_hash, load_hand, read_hand_file
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions

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
    for ending in ("obj", "stl"):
        save_mesh(folder / f"wedge.{ending}", TriangleMesh(WEDGE, np.array(FACES)))
    numbers, indices = " ".join(map(str, WEDGE.ravel())), " ".join(str(i) for face in FACES for i in face)
    (folder / "wedge.dae").write_text(DAE.format(numbers=numbers, indices=indices))
    return folder


def _read(folder: Path, text: str) -> HandModel:
    path = folder / "changed.xml"
    path.write_text(text)
    return read_hand_file(path)


def test_geoms_limits_and_warnings(folder: Path) -> None:
    hand = _read(folder, MJCF)
    kinds = {hand.link_names[p.link]: p.kind for p in hand.primitives}
    # The visual wedge on a2 does not count, because a capsule there collides.
    assert kinds == {"palm": "box", "a": "capsule", "a2": "capsule", "tip": "hull", "b": "hull", "b2": "hull"}
    lower, upper = np.deg2rad([-10, -5, -10]), np.deg2rad([90, 60, 90])
    np.testing.assert_allclose(hand.lower, [*lower, 0])
    np.testing.assert_allclose(hand.upper, [*upper, 0.05])
    finger = hand.primitives_of[hand.link_index["a"]][0]
    assert finger.size == pytest.approx((0.01, 0.025))
    np.testing.assert_allclose(finger.translation, [0, 0, 0.025])
    np.testing.assert_allclose(
        np.ptp(hand.primitives_of[hand.link_index["tip"]][0].vertices, axis=0), [0.02, 0.04, 0.02]
    )
    assert hand.link_mass[hand.link_index["tip"]] == 0.01
    assert [text.split(" was")[0].split(" were")[0] for text in hand.warnings] == [
        "geoms of the world itself",
        "the free joint of the base 'palm'",
    ]


def test_visual_geoms_stand_in_where_none_collides(folder: Path) -> None:
    hand = _read(folder, MJCF.replace('<geom pos="0 0 .02"/>', "", 1))
    assert hand.primitives_of[hand.link_index["a2"]][0].kind == "hull"
    assert any("visual geoms are used: a2" in text for text in hand.warnings)


def test_a_base_that_turns_hangs_in_the_world(folder: Path) -> None:
    hand = _read(folder, MJCF.replace("<freejoint/>", '<joint name="wrist"/>'))
    assert (hand.base_link, hand.joint_names[0]) == ("world", "wrist")
    np.testing.assert_allclose(link_poses(hand, np.zeros(5))[1][hand.link_index["palm"]], [1, 2, 3])


def test_defaults_in_several_sections_and_for_other_actuators_hold(folder: Path) -> None:
    apart = MJCF.replace('<geom type="capsule"/>', '<geom type="capsule"/></default><default>', 1)
    apart = apart.replace("</default>\n<asset>", '<general forcerange="-2 2"/></default>\n<asset>', 1)
    apart = apart.replace(' forcerange="-2 2" kp', " kp", 1)
    whole, hand = _read(folder, MJCF), _read(folder, apart)
    assert [p.kind for p in hand.primitives] == [p.kind for p in whole.primitives]
    assert hand.effort.tolist() == [2.0, np.inf, np.inf, 6.0]
    assert whole.effort.tolist() == [2.0, np.inf, np.inf, 15.0]


def test_ranges_that_do_not_hold_limit_nothing(folder: Path) -> None:
    hand = _read(folder, MJCF.replace("forcerange", 'forcelimited="false" forcerange').replace('"-5 60"', '"3 3"'))
    assert hand.effort.tolist() == [np.inf, np.inf, np.inf, 15.0]
    assert any("joint 'j2' has no limits" in text for text in hand.warnings)


def test_efforts_of_a_joint_with_two_actuators_add_up_and_names_may_begin_like_numbers(folder: Path) -> None:
    text = MJCF.replace('"j1"', '"infra_j1"').replace('"s1"', '"nano"')
    velocity = '<velocity joint="infra_j1" forcerange="-0.5 0.5"/>'
    hand = _read(folder, text.replace("<actuator>", f"<actuator>{velocity}"))
    assert hand.joint_names[0] == "infra_j1"
    assert hand.effort.tolist() == [2.5, np.inf, np.inf, 15.0]


def test_strippath_takes_the_name_of_a_mesh_file_alone(folder: Path) -> None:
    stripped = MJCF.replace("<compiler ", '<compiler strippath="true" ').replace("wedge.obj", "maker/wedge.obj")
    assert len(_read(folder, stripped).primitives) == len(_read(folder, MJCF).primitives)


def test_included_files_are_read_as_if_they_stood_there(folder: Path) -> None:
    """A hand of three files, one of which includes another in a body of the first."""
    head, finger, rest = re.split(r'(?=  <body name="b")|(?=</body></worldbody>)', MJCF)
    (folder / "parts").mkdir()
    (folder / "parts" / "finger.xml").write_text(f"<mujocoinclude>{finger}</mujocoinclude>")
    (folder / "parts" / "middle.xml").write_text('<mujoco><include file="finger.xml"/></mujoco>')
    whole, parts = _read(folder, MJCF), _read(folder, f'{head}<include file="parts/middle.xml"/>{rest}')
    assert parts.link_names == whole.link_names
    assert [p.kind for p in parts.primitives] == [p.kind for p in whole.primitives]
    (folder / "parts" / "finger.xml").write_text("<robot/>")
    with pytest.raises(HandError, match=r"<include file='finger.xml'>: the root element is <robot>"):
        _read(folder, f'{head}<include file="parts/middle.xml"/>{rest}')


def test_an_included_file_that_changes_also_changes_the_hash_of_its_hand(folder: Path) -> None:
    main, part = folder / "main.xml", folder / "limits.xml"
    main.write_text(MJCF.replace("<default>", '<include file="limits.xml"/><default>', 1))
    hashed = []
    for upper in (50, 70, 50):
        limit = f'<default><default class="g"><joint range="0 {upper}"/></default></default>'
        part.write_text(f"<mujocoinclude>{limit}</mujocoinclude>")
        hand_hash.cache_clear()
        hashed.append(hand_hash(str(main)))
    assert hashed[0] != hashed[1]
    assert hashed[0] == hashed[2]


def test_where_the_base_stands_in_its_file_is_kept(folder: Path) -> None:
    """The base's frame stays the base body's own; grasps of others are poses of the file's world."""
    place, turn = _read(folder, MJCF).base_place
    assert place == (1.0, 2.0, 3.0)
    # As the axes of z, y', x'' turn by 10, 20 and 30 degrees.
    z, y, x = (np.radians(angle) / 2 for angle in (10, 20, 30))
    assert turn[0] == pytest.approx(np.cos(z) * np.cos(y) * np.cos(x) + np.sin(z) * np.sin(y) * np.sin(x))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<freejoint/>", '<include file="x.xml"/>', "<include file='x.xml'>: no such file beside changed.xml"),
        ("<freejoint/>", '<include file="changed.xml"/>', "<include file='changed.xml'>: included twice"),
        ("<equality>", '<equality><connect body1="a" body2="b" anchor="0 0 0"/>', "write <joint joint1 joint2 pol"),
        ('<body name="tip"', '<replicate count="9"/><body name="tip"', "body 'a2': <replicate> is not read"),
        ("</worldbody>", '<body name="mug"/></worldbody>', "the world has 2 bodies: palm, mug; valid: one"),
        ('type="slide"', 'type="ball"', "joint 's1' is of type 'ball'; known: hinge, slide"),
        ('range="0 .05"', "", "joint 's1' has a travel of 100 m"),
        ('range="-5 60"', 'range="5 -60"', "joint 'j2' has lower 5 above upper -60"),
        ('axis="1 0 1"', 'axis="0 0 0"', "changed.xml:8: .*axis too small in joint Element name 'j2'"),
        ('euler="10 -', 'quat="1 0 0 0" euler="10 -', "changed.xml:7: body 'a': .*multiple orientation specifiers"),
        ('eulerseq="zyx"', 'eulerseq="zz"', "changed.xml:1: .*'eulerseq' must have exactly 3 characters"),
        ('childclass="f"', 'childclass="g"', "changed.xml:6: body 'palm': .*unknown default childclass"),
        ('size=".01 .02 .01"', 'size=".01 -.02 .01"', "changed.xml:13: .*size 1 must be positive in geom"),
        ('type="ellipsoid"', 'type="hfield"', "body 'tip': <geom type='hfield'> is not read; known: sphere"),
        ('mesh="w"', 'mesh="q"', "unknown mesh 'q'; valid: t, w"),
        ('type="mesh" mesh="w"', 'type="box" mesh="w"', "mesh='w'>: no box is fitted to a mesh; give type='mesh'"),
        (
            'vertex="0 0 0 .02 0 0 0 .02 0 0 0 .03"',
            'vertex="0 0 0"',
            "mesh 't': <mesh vertex=...>: 1 points; expected four",
        ),
        (
            'scale="1 -1 1"',
            'scale=".001 -.001 .001"',
            "mesh 't': <mesh vertex=...>: 4 points; .*0.0003 m across or more",
        ),
        ('file="wedge.obj"', 'file="lost.obj"', "mesh 'w': mesh 'lost.obj' was not found"),
        ('polycoef="0.1 .5 0 0 0"', 'polycoef="0.1 .5 2 0 0"', "not linear; valid: zeros"),
        ('joint2="j3"', 'joint2="j9"', "changed.xml:19: .*unknown element 'j9' in equality constraint"),
        ("<equality>", '<equality><weld body1="a" body2="b"/>', "equality <weld> is not supported"),
        ('fromto="0 0 0 0 0 .05"', 'fromto="0 0 0 0 0 0"', "changed.xml:9: .*fromto points too close"),
        ('name="b2"', 'name="a2"', "MuJoCo refuses it: .*repeated name 'a2' in body"),
        ('mass=".01"', 'mass="-1"', "body 'tip': mass -1 kg"),
        ('gear="3"', 'gear="3 e"', "changed.xml:20: .*bad format in attribute 'gear'"),
        ('ref=".01"', 'ref="nan"', "joint 's1': <joint ref='nan'>: expected finite numbers"),
        ("</worldbody>", "<site><body/></site>" * 301 + "</worldbody>", "307 links; a hand has at most 300"),
    ],
)
def test_what_is_not_read_is_named(folder: Path, old: str, new: str, message: str) -> None:
    assert old in MJCF
    with refused(HandError, start=str(folder / "changed.xml"), match=message):
        _read(folder, MJCF.replace(old, new, 1))


# Trees are small as drawn, and shrinking one takes minutes.
DRAWS = {
    "phases": [Phase.reuse, Phase.generate],
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}


def _check_against_mujoco(
    hand: HandModel, model: mujoco.MjModel, base: str | None, values: dict[str, float], q: np.ndarray
) -> None:
    data = mujoco.MjData(model)
    for name, value in values.items():
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    rotations, translations = link_poses(hand, q)
    turn = data.body(base).xmat.reshape(3, 3) if base else np.eye(3)
    origin = data.body(base).xpos if base else np.zeros(3)
    names = {model.body(i).name for i in range(model.nbody)} & set(hand.link_names)
    assert names >= {name for name in hand.link_names[1:] if ":" not in name}
    for name in names:
        link, body = hand.link_index[name], data.body(name)
        # Both count in float64; the bound that is promised is 1e-5.
        np.testing.assert_allclose(translations[link], turn.T @ (body.xpos - origin), atol=1e-9)
        np.testing.assert_allclose(rotations[link], turn.T @ body.xmat.reshape(3, 3), atol=1e-9)


@settings(max_examples=12, **DRAWS)
@given(data=st.data(), seed=st.integers(0, 2**31))
def test_any_tree_moves_as_in_mujoco(folder: Path, data: st.DataObject, seed: int) -> None:
    text, couplings = data.draw(urdfs())
    path = folder / "zoo.urdf"
    path.write_text(text)
    hand = read_hand_file(path)
    q = np.random.default_rng(seed).uniform(hand.lower, hand.upper)
    values = dict(zip(hand.joint_names, q.tolist(), strict=True))

    def value(name: str) -> float:
        if name not in couplings:
            return values[name]
        leader, multiplier, offset = couplings[name]
        return multiplier * value(leader) + offset

    every = {name: value(name) for name in all_joint_names(hand)}
    np.testing.assert_allclose(all_joint_positions(hand, q), list(every.values()), atol=1e-12)
    # MuJoCo wants masses, knows no capsule in a URDF and ignores couplings: it is shown the bare tree.
    bare = re.sub(r"<(collision|visual)>.*?</\1>|<mimic.*?/>", "", text)
    bare = re.sub(r"(<link name=\"\w+\">)", r'\1<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
                  r'ixy="0" ixz="0" iyz="0"/></inertial>', bare)  # fmt: skip
    bare = bare.replace('<robot name="zoo">', '<robot name="zoo"><mujoco><compiler fusestatic="false"/></mujoco>')
    _check_against_mujoco(hand, mujoco.MjModel.from_xml_string(bare), None, every, q)


@pytest.mark.parametrize("seed", range(3))
def test_an_mjcf_file_moves_as_in_mujoco(folder: Path, seed: int) -> None:
    path = folder / "tri.xml"
    path.write_text(MJCF)
    hand = read_hand_file(path)
    assert (hand.name, hand.base_link, hand.joint_names) == ("tri", "palm", ("j1", "j2", "j3", "s1"))
    np.testing.assert_allclose(hand.effort, [2, np.inf, np.inf, 15])
    q = np.random.default_rng(seed).uniform(hand.lower, hand.upper)
    values = dict(zip(all_joint_names(hand), all_joint_positions(hand, q).tolist(), strict=True))
    model = mujoco.MjModel.from_xml_path(str(path))
    _check_against_mujoco(hand, model, "palm", values, q)
    # What MuJoCo's equality constraint wants of the coupled joint, as its documentation states it.
    reference = {name: float(model.joint(name).qpos0[0]) for name in ("k", "j3")}
    wanted = reference["k"] + 0.1 + 0.5 * (values["j3"] - reference["j3"])
    assert values["k"] == pytest.approx(wanted)


@pytest.mark.slow
@settings(max_examples=6, deadline=None, **DRAWS)
@given(data=st.data())
def test_any_tree_is_given_a_palm_postures_and_candidates(folder: Path, data: st.DataObject) -> None:
    path = folder / "whole.urdf"
    path.write_text(data.draw(urdfs())[0])
    hand = load_hand(path, candidates=60)
    for posture in (hand.open_posture, hand.closed_posture):
        assert ((hand.lower <= posture) & (posture <= hand.upper)).all()
    for direction in (hand.palm_normal, hand.approach):
        assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert np.isfinite(hand.palm_center).all()
    assert len(hand.candidate_points) > 0


def test_masses_that_geoms_give_instead_of_inertials_are_left_out(folder: Path) -> None:
    """MuJoCo sees a small sphere instead of the mesh of `b2`. The mass of that sphere is not the link's."""
    heavy = MJCF.replace('ref="5"/>', 'ref="5"/><inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>')
    assert _read(folder, heavy).link_mass.max() == 2.0
    by_geoms = _read(folder, heavy.replace("<compiler ", '<compiler inertiafromgeom="true" '))
    assert not by_geoms.link_mass.any()
    assert not by_geoms.link_inertia.any()


def test_a_total_mass_scales_all_masses_without_a_warning(tmp_path: Path) -> None:
    bodies = """<body name="palm"><inertial pos="0 0 0" mass=".3" diaginertia="1e-4 1e-4 1e-4"/>
    <body name="tip"><inertial pos="0 0 0" mass=".1" diaginertia="1e-5 1e-5 1e-5"/>
    <joint name="j" range="0 1"/><geom size=".01"/></body></body>"""
    text = f'<mujoco><compiler settotalmass="2" angle="radian"/><worldbody>{bodies}</worldbody></mujoco>'
    hand = _read(tmp_path, text)
    np.testing.assert_allclose(hand.link_mass, [1.5, 0.5])
    np.testing.assert_allclose(np.diag(hand.link_inertia[1]), 5e-5)
