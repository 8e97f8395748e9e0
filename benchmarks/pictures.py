"""Draw the pictures of the docs. Not a test.

    python benchmarks/pictures.py [--figures docs/figures] [--pages results/bench]

Without --pages, draw grasps.png of README.md, and view_hero.png, view_sequence.png, view_cloud.png, view_hands.png and
view_failed.png of docs/viewer.md. Rays are cast at the meshes of `graspd_viewer.drawing`, so no browser or screen is
needed, and every run draws the same. With --pages, take the screenshots of docs/viewer.md instead. One of them shows
the given benchmark. Screenshots need playwright and Chromium, and differ a little each time.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

# One thread, so that all machines find the same grasps. The variable must be set before torch is imported.
os.environ.update(OMP_NUM_THREADS="1")

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from graspd_bench.rendering.depth_noise import DepthNoise
from graspd_bench.rendering.render import camera_of_view, look_at, render_scene, render_shaded, save_png
from graspd_bench.rendering.tabletop import ring_poses, tabletop, views_of
from graspd_core import HandModel, hand_names, load_hand, load_preset, load_scene, plan_grasps
from graspd_core.perception.scene import Scene, object_parts
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.se3 import perpendicular, rotation_from_quaternion
from graspd_core.types import Grasp, Posture, TriangleMesh, Verdict
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_core.verify.trial_registry import build_worlds
from graspd_core.verify.world import PROTOCOLS
from graspd_viewer.bench_page import bench_page
from graspd_viewer.drawing import (
    SEEN,
    STAGES,
    Part,
    contact_parts,
    force_parts,
    hand_parts,
    placed_links,
    posture_at,
    scene_parts,
    squeeze_parts,
    weakest_parts,
    weakest_push,
)
from graspd_viewer.session import make_session
from graspd_viewer.trial_controls import record_trial
from graspd_viewer.viewer import Viewer

# Objects on the README's picture, and the hand that grasps each.
PAIRS = (("shape:mug", "allegro_right"), ("shape:torus", "barrett_like"), ("shape:hammer", "leap_right"))
# Rotations about the vertical among which `clearest` chooses [rad].
TURNS = np.arange(0.0, 2 * np.pi, np.pi / 8)
# Height of a picture [pixels]. Each pixel is the mean of `FINER` x `FINER` rays.
SIDE, FINER = 360, 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figures", type=Path, default=Path("docs/figures"))
    parser.add_argument("--pages", type=Path, default=None, metavar="BENCHMARK", help="take screenshots instead")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.figures.mkdir(parents=True, exist_ok=True)
    if options.pages:
        pages(options.figures, options.pages)
        return
    mug, hand, config = load_scene("shape:mug"), load_hand("allegro_right"), load_preset("balanced")
    grasps = plan_grasps(mug, hand, count=8, preset=config, measure=False).grasps
    pictures = {
        "grasps": pairs(),
        "view_hero": hero(mug, hand, grasps[0]),
        "view_sequence": sequence(mug, hand, grasps[0]),
        "view_cloud": cloud(),
        "view_hands": hands(),
        "view_failed": failed(),
    }
    for name, picture in pictures.items():
        path = options.figures / f"{name}.png"
        save_png(path, picture)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def pages(figures: Path, benchmark: Path) -> None:
    """Save screenshots: the page (grasps, a failed trial, an SDF slice, a run, the help) and a benchmark's chart."""
    from playwright.sync_api import sync_playwright

    sys.path.insert(0, str(Path(__file__).parents[1] / "test" / "viewer"))
    from conftest import FLAGS, Page  # pyright: ignore

    scene, hand, config = load_scene("shape:mug"), load_hand("allegro_right"), load_preset("fast")
    grasps = plan_grasps(scene, hand, count=16, preset=config).grasps
    viewer = Viewer(port=0)
    viewer.show(make_session("mug", hand, grasps, scene, config, np.zeros((0, 3)), ()))
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = Page(browser.new_page(viewport={"width": 1000, "height": 760}))

        def shoot(name: str, wait: float = 3000) -> None:
            page.tab.wait_for_timeout(wait)
            image = Image.open(io.BytesIO(page.tab.screenshot())).convert("RGB").quantize(192)
            image.save(figures / f"{name}.png", optimize=True)

        page.tab.goto(viewer.url)
        page.text("#0 verified")
        # Close viser's notification about rendering in software.
        page.tab.locator(".mantine-Notification-closeButton").first.click(timeout=10_000)
        shoot("view_page")
        page.choose("Show", "failed")
        page.press("Run and play")
        page.text(re.compile(r"failed at \d"))
        shoot("view_trial", 8000)
        page.choose("Show", "verified")
        page.tab.get_by_text("What is shown").click()
        page.choose("Distance slice", "x")
        page.set("Opacity", 0.3)
        shoot("view_slice")
        page.choose("Distance slice", "none")
        page.set("Opacity", 1.0)
        page.tab.get_by_role("tab", name="Plan").click()
        page.choose("Preset", "accurate")
        page.press("Plan")
        page.text(re.compile(r"trying \d+ of \d+, [3-9] verified"))
        shoot("view_live", 300)
        page.press("Stop")
        page.tab.get_by_role("tab", name="Help").click()
        page.tab.get_by_role("checkbox").filter(visible=True).first.click()
        shoot("view_help")
        (figures / "page.html").write_text(bench_page(benchmark, served=True)[0])
        page.tab.set_viewport_size({"width": 1200, "height": 900})
        page.tab.goto((figures / "page.html").resolve().as_uri())
        page.tab.locator("circle[data-name=fast]").first.click()
        page.tab.locator("summary").filter(has_text="plate").first.click()
        shoot("view_bench")
        (figures / "page.html").unlink()
        browser.close()
    viewer.close()


def pairs() -> np.ndarray:
    """Return a picture of three hands, each with its best verified grasp. Raise RuntimeError if there is none."""
    found = []
    for source, name in PAIRS:
        scene, hand = load_scene(source), load_hand(name)
        best = plan_grasps(scene, hand, count=4, measure=False).grasps[0]
        if best.verdict is not Verdict.VERIFIED:
            raise RuntimeError(f"{source} by {name}: {best.reason}")
        drawn, held = scene_parts(scene), at(hand, best.grasp)
        found.append(shot(scene, drawn + held, near=1.25, turn=clearest(scene, drawn, held)))
    return np.hstack(found)


def hero(scene: Scene, hand: HandModel, grasp: Grasp) -> np.ndarray:
    """Return a picture of a grasp, and of the object with contacts, squeeze forces and the least resisted push."""
    push = weakest_push(make_metrics_context(scene.object, hand), grasp)
    marks = [*contact_parts(grasp.contacts), *squeeze_parts(grasp.contacts)]
    marks += weakest_parts(push, scene.object) if push is not None else []
    drawn = scene_parts(scene)
    return np.hstack([shot(scene, drawn + at(hand, grasp.squeeze), near=1.2), shot(scene, drawn + marks, near=1.2)])


def sequence(scene: Scene, hand: HandModel, grasp: Grasp) -> np.ndarray:
    """Return pictures of the hand from the retreat to the squeeze."""
    ways = (posture_at(hand, grasp, float(stage)) for stage in range(len(STAGES)))
    return np.hstack([shot(scene, scene_parts(scene) + at(hand, way), near=0.8) for way in ways])


def cloud() -> np.ndarray:
    """Return pictures of a mug seen by one camera: the cloud, the seen and guessed surface, and a grasp."""
    table = tabletop("mug", yaw=2.2)
    camera = camera_of_view(320, 240)
    poses = ring_poses(1, distance=0.5, elevation=0.7)
    views = views_of(table, camera, poses, DepthNoise(), seed=0)
    scene = scene_from_views(views)
    hand = load_hand("allegro_right")
    best = plan_grasps(scene, hand, count=1, preset="fast", measure=False).grasps[0]
    drawn = scene_parts(scene)
    seen = [dots(np.concatenate([view.points for view in views]), scene), *drawn[2:3]]
    held = at(hand, best.grasp)
    turn = clearest(scene, drawn[:2], held)
    return np.hstack([shot(scene, p, near=1.3, turn=turn) for p in (seen, drawn, drawn + held)])


def dots(points: np.ndarray, scene: Scene) -> Part:
    """Return the points within 3 cm of the object's bounding box as small tetrahedra."""
    corners = scene.object.mesh.vertices
    near = ((points > corners.min(0) - 0.03) & (points < corners.max(0) + 0.03)).all(1)
    solid = 0.0008 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    kept = points[near]
    vertices = (kept[:, None] + solid).reshape(-1, 3)
    return Part("cloud", TriangleMesh(vertices, (faces + 4 * np.arange(len(kept))[:, None, None]).reshape(-1, 3)), SEEN)


def hands() -> np.ndarray:
    """Return pictures of a bottle grasped by each hand that graspd ships."""
    scene, found = load_scene("shape:bottle"), []
    for name in hand_names():
        hand = load_hand(name)
        best = plan_grasps(scene, hand, count=1, preset="fast", measure=False).grasps[0]
        found.append(shot(scene, scene_parts(scene) + at(hand, best.grasp), width=0.7, near=1.3))
    return np.hstack(found)


def failed() -> np.ndarray:
    """Return pictures of a trial without squeeze, which fails: when the pull begins, half-way, and at the failure."""
    scene, hand = load_scene("shape:bottle"), load_hand("barrett_like")
    grasp = plan_grasps(scene, hand, count=1, preset="fast", measure=False).grasps[0]
    soft = grasp.grasp.joint_positions
    weak = replace(grasp, squeeze=replace(grasp.squeeze, joint_positions=soft))
    worlds = build_worlds(scene, hand, object_parts(scene.object), PROTOCOLS["standard"])
    frames = record_trial(worlds, weak, "hold").frames
    begun = next(index for index, frame in enumerate(frames) if frame.stage == frames[-1].stage)
    shots = []
    for frame in (frames[begun], frames[(begun + len(frames)) // 2], frames[-1]):
        links = [moved(part, frame.positions[link], frame.quaternions[link]) for link, part in hand_parts(hand).items()]
        things = [moved(part, frame.positions[-1], frame.quaternions[-1]) for part in scene_parts(scene)]
        shots.append(shot(scene, [*links, *things, *force_parts(frame.contacts, frame.forces)], near=0.9))
    return np.hstack(shots)


def at(hand: HandModel, posture: Posture) -> list[Part]:
    """Return the parts of the hand at a posture."""
    positions, quaternions = placed_links(hand, posture)
    return [moved(part, positions[link], quaternions[link]) for link, part in hand_parts(hand).items()]


def moved(part: Part, position: np.ndarray, quaternion: np.ndarray) -> Part:
    """Return the part at a pose: position [m] and quaternion wxyz."""
    rotation = rotation_from_quaternion(torch.as_tensor(quaternion).double()).numpy()
    return replace(part, mesh=TriangleMesh(part.mesh.vertices @ rotation.T + position, part.mesh.faces))


def shot(
    scene: Scene, parts: Sequence[Part], *, width: float = 1.0, near: float = 1.0, turn: float = 0.0
) -> np.ndarray:
    """Return a picture of parts, with the support's normal up. `width` is a fraction of the picture's height."""
    meshes, pose = stood(scene, parts, near, turn)
    colours = [part.colour for part in parts]
    size = {"width": round(width * SIDE) * FINER, "height": SIDE * FINER}
    fine = render_shaded(list(zip(meshes, colours, strict=True)), T_world_camera=pose, **size).astype(float)
    rows, columns = SIDE, round(width * SIDE)
    return fine.reshape(rows, FINER, columns, FINER, 3).mean((1, 3)).astype(np.uint8)


def clearest(scene: Scene, shown: Sequence[Part], before: Sequence[Part]) -> float:
    """Return the rotation in `TURNS` [rad] at which the parts `before` hide the least of the parts `shown`."""

    def seen(turn: float) -> int:
        meshes, pose = stood(scene, [*shown, *before], 1.0, turn)
        return int(np.isin(render_scene(meshes, camera_of_view(60, 60), pose)[1], range(len(shown))).sum())

    return max(TURNS, key=seen)


def stood(
    scene: Scene, parts: Sequence[Part], near: float, turn: float
) -> tuple[list[TriangleMesh], Float[np.ndarray, "4 4"]]:
    """Return meshes, turned so that up is z and then by `turn` [rad] about z, and the camera pose. Light is from z."""
    corners = scene.object.mesh.vertices
    middle = 0.5 * (corners.min(0) + corners.max(0))
    up = np.array([0.0, 0.0, 1.0]) if scene.support is None else scene.support.normal
    first = perpendicular(up)
    side = np.cos(turn) * first + np.sin(turn) * np.cross(up, first)
    rotation = np.stack([side, np.cross(up, side), up])
    distance = (0.30 + 1.2 * float(np.ptp(corners, axis=0).max())) / near
    pose = look_at(distance * np.array([0.75, 0.55, 0.45]), np.zeros(3))
    return [TriangleMesh((p.mesh.vertices - middle) @ rotation.T, p.mesh.faces) for p in parts], pose


if __name__ == "__main__":
    main()
