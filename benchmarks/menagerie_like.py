"""MJCF of an Allegro with the frames of MuJoCo Menagerie's right hand. Tests of exports for DexGraspBench use it."""

from __future__ import annotations


def menagerie_like() -> str:
    """Return the MJCF of an Allegro with Menagerie's names and frames. The palm is rotated against the root frame."""

    def finger(name: str, place: str) -> str:
        lengths, axes = ("0 0 0.0164", "0 0 0.054", "0 0 0.0384"), ("0 0 1", "0 1 0", "0 1 0", "0 1 0")
        return chain(name, place, lengths, axes)

    def chain(name: str, place: str, steps: tuple[str, ...], axes: tuple[str, ...]) -> str:
        text, places = "", (place, *(f'pos="{step}"' for step in steps))
        for number, (where, axis) in enumerate(zip(places, axes, strict=True)):
            text += f'<body name="{name}{number}" {where}><joint name="{name}j{number}" axis="{axis}"/>'
            text += '<geom size="0.005"/>'
        return text + "</body>" * len(axes)

    tilt, thumb = "0.0436194 0 0", 'pos="-0.0182 0.019333 -0.045987" quat="0.477714 -0.521334 -0.521334 -0.477714"'
    fingers = [
        finger("ff", f'pos="0 0.0435 -0.001542" quat="0.999048 -{tilt}"'),
        finger("mf", 'pos="0 0 0.0007"'),
        finger("rf", f'pos="0 -0.0435 -0.001542" quat="0.999048 {tilt}"'),
        chain("th", thumb, ("-0.027 0.005 0.0399", "0 0 0.0177", "0 0 0.0514"), ("-1 0 0", "0 0 1", "0 1 0", "0 1 0")),
    ]
    palm = f'<body name="palm" quat="0 1 0 1"><geom size="0.01"/>{"".join(fingers)}</body>'
    hand = f'<body name="hand"><freejoint/><geom size="0.01"/>{palm}</body>'
    return f'<mujoco><compiler angle="radian"/><worldbody>{hand}</worldbody></mujoco>'
