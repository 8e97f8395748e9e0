"""Real RGB-D frames: segmentation against a reference cloud, reconstruction, verified grasps, and a picture of each."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from rgbd_cases import Case, warm_front, warm_hand

from graspd_core.errors import GraspdError

# Clouds are compared by the cubes of this side that they touch [m].
CUBE = 0.005
SEEN, GUESSED, SKIN, OTHER = (0.35, 0.55, 0.8), (0.95, 0.85, 0.5), (0.8, 0.5, 0.4), (0.9, 0.9, 0.88)
# Surface farther than this from every seen point was guessed [m].
NEAR_SEEN = 0.006


def read_frame(folder: Path) -> tuple[Any, np.ndarray]:
    """The cloud of a depth image in its camera's frame, and the reference cloud of its object [m]."""
    import open3d as o3d

    from graspd_core.pointcloud.camera import PinholeCamera
    from graspd_core.pointcloud.depth_image import cloud_from_depth, depth_in_metres

    info = json.loads((folder / "camera.json").read_text())
    k = info["K"]
    camera = PinholeCamera(info["width"], info["height"], k[0][0], k[1][1], k[0][2], k[1][2])
    depth = depth_in_metres(np.asarray(o3d.io.read_image(folder / "depth_mm.png")), "16UC1")
    return cloud_from_depth(depth, camera), np.loadtxt(folder / "object_cloud.xyz")


def overlap(found: np.ndarray, reference: np.ndarray) -> float:
    """Intersection over union of the 5 mm cubes that two clouds touch."""
    a, b = ({tuple(c) for c in np.floor(points / CUBE).astype(int)} for points in (found, reference))
    return len(a & b) / max(len(a | b), 1)


def run_frames(folder: Path, pictures: Path, *, count: int, preset: str) -> list[dict]:
    """Every frame below `folder`, in order of name; pictures are written to `pictures`."""
    pictures.mkdir(parents=True, exist_ok=True)
    hand = warm_hand(preset)
    warm_front(Case.front)
    return [
        run_frame(frame.parent, pictures, hand, count=count, preset=preset)
        for frame in sorted(folder.glob("*/depth_mm.png"))
    ]


def run_frame(folder: Path, pictures: Path, hand: Any, *, count: int, preset: str) -> dict:
    """The object nearest the view axis; where that is not the reference's, the one at the reference's centre."""
    from graspd_core.mesh.topology import is_closed
    from graspd_core.planning.plan_grasps import plan_grasps
    from graspd_core.scene.scene_from_views import scene_from_views
    from graspd_core.segmentation.segment import Target, segment
    from graspd_core.types import Verdict

    cloud, reference = read_frame(folder)
    report: dict[str, Any] = {"frame": folder.name, "points": len(cloud.points)}
    target = None
    try:
        for picked in ("view axis", "point"):
            if picked == "point":
                target = Target(point=np.median(reference, axis=0))
            began = time.perf_counter()
            parted = segment([cloud], target=target)
            segment_s = time.perf_counter() - began
            seen = np.vstack([view.points for view in parted.views])
            report |= {"picked_by": picked, "object_points": len(seen), "iou": overlap(seen, reference)}
            if report["iou"] > 0.5:
                break
        began = time.perf_counter()
        scene = scene_from_views([cloud], target=target, source=folder.name)
        scene_s = time.perf_counter() - began
        report |= {"segment_s": segment_s, "scene_s": scene_s, "watertight": bool(is_closed(scene.object.mesh))}
        report["extent_mm"] = [round(1e3 * float(x)) for x in np.ptp(scene.object.mesh.vertices, axis=0)]
        result = plan_grasps(scene, hand, count=count, preset=preset)
    except GraspdError as error:
        return {**report, "error": str(error)}
    timing = result.timing
    if timing.first_verified is not None:
        report["first_s"] = scene_s + timing.first_verified - timing.load - timing.sdf
    good = [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED]
    picture = pictures / f"{folder.name}.png"
    draw(scene, hand, good[0].grasp if good else None, seen, cloud.viewpoint, picture)
    return report | {
        "verified": len(good),
        "asked": count,
        "tried": len(result.grasps),
        "outcome": result.outcome.name,
        "neighbours": len(scene.obstacles),
        "support": scene.support is not None,
        "warnings": list(result.warnings),
        "picture": str(picture),
    }


def draw(scene: Any, hand: Any, posture: Any, points: np.ndarray, eye: np.ndarray, path: Path) -> None:
    """Hand and reconstruction, seen surface blue and guessed surface yellow: from the camera, a side, and behind."""
    from scipy.spatial import KDTree
    from scipy.spatial.transform import Rotation

    from graspd_core.hands.hand_mesh import hand_mesh
    from graspd_core.rendering.render import look_at, render_shaded, save_png
    from graspd_core.types import TriangleMesh

    mesh = scene.object.mesh
    near = KDTree(points).query(mesh.vertices[mesh.faces].mean(1))[0] < NEAR_SEEN
    things = [
        (TriangleMesh(mesh.vertices, mesh.faces[rows]), colour)
        for rows, colour in ((near, SEEN), (~near, GUESSED))
        if rows.any()
    ]
    things += [(n.mesh, OTHER) for n in scene.obstacles]
    centre = mesh.vertices.mean(0)
    up = np.array([0.0, -1.0, 0.0])
    if scene.support is not None:
        up = scene.support.normal
        things.append((disc(scene.support, centre), OTHER))
    if posture is not None:
        turn = Rotation.from_quat(posture.quaternion_wxyz, scalar_first=True).as_matrix()
        local = hand_mesh(hand, posture.joint_positions)
        things.append((TriangleMesh(local.vertices @ turn.T + posture.position, local.faces), SKIN))
    view = (centre - eye) / np.linalg.norm(centre - eye)
    side = np.cross(view, up) / np.linalg.norm(np.cross(view, up))
    places = [centre - 0.55 * view, centre + 0.5 * side + 0.2 * up, centre + 0.5 * view + 0.3 * up]
    images = [render_shaded(things, T_world_camera=look_at(place, centre, up), width=480) for place in places]
    save_png(np.concatenate(images, axis=1), path)


def disc(support: Any, centre: np.ndarray) -> Any:
    """The table about the object, as a flat disc of 15 cm radius."""
    from graspd_core.types import TriangleMesh

    middle = centre - (support.normal @ centre - support.offset) * support.normal
    first = np.cross(support.normal, np.eye(3)[np.abs(support.normal).argmin()])
    first /= np.linalg.norm(first)
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)[:, None]
    rim = middle + 0.15 * (np.cos(turn) * first + np.sin(turn) * np.cross(support.normal, first))
    index = np.arange(48)
    return TriangleMesh(np.vstack([rim, middle]), np.column_stack([index, (index + 1) % 48, np.full(48, 48)]))


def frames_table(frames: list[dict]) -> str:
    """The results as Markdown."""
    lines = [
        "| frame | object picked by | points | IoU with the reference | closed | verified grasps | scene "
        "| first verified grasp |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for f in frames:
        if "error" in f:
            lines.append(f"| {f['frame']} | {f.get('picked_by', '–')} | {f['error']} | | | | | |")
            continue
        first = f"{f['first_s']:.1f} s" if "first_s" in f else "none"
        closed = "yes" if f["watertight"] else "no"
        lines.append(
            f"| {f['frame']} | {f['picked_by']} | {f['object_points']} | {f['iou']:.2f} | {closed} "
            f"| {f['verified']} of {f['asked']} | {f['scene_s']:.1f} s | {first} |"
        )
    return "\n".join(lines)
