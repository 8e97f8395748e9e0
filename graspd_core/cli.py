"""The command line: `graspd synthesize | reconstruct | hands | doctor`. Heavy imports wait for who needs them."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from graspd_core.config import METHODS, VERIFICATIONS, load_preset, preset_names
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.types import GraspResult, Outcome, Progress, Stage, Verdict

EXIT_OK, EXIT_BAD_INPUT, EXIT_TOO_FEW, EXIT_INTERRUPTED = 0, 2, 3, 130
_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 0.0254}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status: 0 enough grasps, 3 fewer, 2 bad input, 130 interrupted."""
    try:
        options = build_parser().parse_args(arguments)
        return int(options.run(options))
    except (GraspdError, OSError) as error:
        print(f"graspd: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("graspd: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


class _Parser(argparse.ArgumentParser):
    """Wrong options are errors like any other: one line, no usage text before it."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; raises ConfigError for options that it does not know."""
    parser = _Parser(prog="graspd", description="Verified grasps for multi-fingered hands.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    synthesize = commands.add_parser("synthesize", help="plan grasps on a mesh, a cloud or a boxed shape")
    synthesize.set_defaults(run=_synthesize)
    synthesize.add_argument("object", metavar="OBJECT", help="mesh or cloud file, or shape:NAME")
    synthesize.add_argument("--hand", default="allegro_right", metavar="NAME|PATH", help="graspd hands lists the names")
    synthesize.add_argument("-n", "--count", type=int, default=16, help="verified grasps wanted (default 16)")
    synthesize.add_argument("--method", choices=METHODS, default=None)
    synthesize.add_argument("--preset", default="balanced", help=f"{', '.join(preset_names())}, or a .yaml file")
    synthesize.add_argument("--seed", type=int, default=0)
    synthesize.add_argument("--mass", type=float, default=0.1, metavar="KG", help="of the object (default 0.1)")
    synthesize.add_argument("--friction", type=float, default=0.6, metavar="MU", help="default 0.6")
    sizes = synthesize.add_mutually_exclusive_group()
    sizes.add_argument("--scale", type=float, default=1.0, metavar="S", help="metres per unit of the file")
    sizes.add_argument("--units", choices=tuple(_UNITS), default=None, help="unit of the file's coordinates")
    synthesize.add_argument("--deadline", type=float, default=None, metavar="SEC", help="end with what there is then")
    synthesize.add_argument("--verify", choices=VERIFICATIONS, default="standard")
    synthesize.add_argument("--device", default="cpu", help="torch device of the optimiser")
    synthesize.add_argument("--threads", type=int, default=1, help="torch threads (default 1)")
    synthesize.add_argument("--out", type=Path, default=None, metavar="grasps.json")
    synthesize.add_argument("--html", type=Path, default=None, metavar="view.html")
    reconstruct = commands.add_parser("reconstruct", help="turn a point cloud into a closed mesh")
    reconstruct.set_defaults(run=_reconstruct)
    reconstruct.add_argument("cloud", metavar="CLOUD", type=Path)
    reconstruct.add_argument("--out", type=Path, required=True, metavar="mesh.ply")
    hands = commands.add_parser("hands", help="list the hands in the box")
    hands.set_defaults(run=_hands)
    doctor = commands.add_parser("doctor", help="check the installation")
    doctor.set_defaults(run=_doctor)
    return parser


def _synthesize(options: argparse.Namespace) -> int:
    import dataclasses

    import torch

    from graspd_core.io import check_writable, save_result
    from graspd_core.pipeline import check_request, load_hand, load_scene, plan_grasps

    request = {name: getattr(options, name) for name in ("count", "seed", "verify", "deadline", "device")}
    check_request(**request)
    if options.threads < 1:
        raise ConfigError(f"threads: {options.threads}; at least 1")
    # A run whose result could not be written would be lost.
    for path in (options.out, options.html):
        if path:
            check_writable(path)
    torch.set_num_threads(options.threads)
    config = load_preset(options.preset)
    if options.method:
        config = dataclasses.replace(config, method=options.method)
    scale = _UNITS[options.units] if options.units else options.scale
    scene = load_scene(
        options.object,
        mass=options.mass,
        friction=options.friction,
        scale=scale,
        resolution=config.resolution,
    )
    hand = load_hand(options.hand, candidates=config.closed_form.fine_candidates)
    for warning in scene.object.warnings:
        print(f"graspd: {warning}", file=sys.stderr)
    with _Reporter() as reporter, _Interrupt() as interrupt:
        result = plan_grasps(scene, hand, preset=config, progress=reporter, stop=interrupt.came, **request)
    if options.out:
        save_result(options.out, result, scene.object, hand, config)
    if options.html:
        from graspd_core.html import save_view

        save_view(options.html, scene.object.mesh, hand, result.grasps)
    print(summary(result, options.count))
    if result.outcome is Outcome.CANCELLED:
        return EXIT_INTERRUPTED
    return EXIT_OK if result.outcome is Outcome.SUCCEEDED else EXIT_TOO_FEW


def summary(result: GraspResult, wanted: int) -> str:
    """A few lines for a person."""
    good = [g for g in result.grasps if g.verdict is not Verdict.FAILED]
    kind = "unverified" if any(g.verdict is Verdict.UNVERIFIED for g in good) else "verified"
    lines = [f"{len(good)} of {wanted} grasps ({kind}, {len(result.grasps)} tried): {result.outcome.value}"]
    timing = result.timing
    lines.append(
        f"load {timing.load:.2f} s, sdf {timing.sdf:.2f} s, optimise {timing.optimise:.2f} s, "
        f"verify {timing.verify:.2f} s, total {timing.total:.2f} s"
        + (f", first verified after {timing.first_verified:.2f} s" if timing.first_verified else "")
    )
    for rank, grasp in enumerate(good[:3]):
        if grasp.metrics:
            lines.append(
                f"  #{rank}: {len(grasp.contacts)} contacts, penetration {grasp.metrics.penetration * 1e3:.1f} mm, "
                f"contact area {grasp.metrics.contact_area * 1e4:.1f} cm², epsilon {grasp.metrics.epsilon:.3f}"
            )
    return "\n".join(lines)


class _Interrupt:
    """The first Ctrl-C ends a run, which keeps what it has found so far; the second ends the process."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def __enter__(self) -> _Interrupt:
        # Signals belong to the main thread; in another one, who runs us keeps them.
        self._mine = threading.current_thread() is threading.main_thread()
        if self._mine:
            self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        if self._mine:
            signal.signal(signal.SIGINT, self._before)

    def came(self) -> bool:
        return self._event.is_set()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._event.is_set():
            raise KeyboardInterrupt
        self._event.set()


class _Reporter:
    """Progress on a terminal as a bar, elsewhere as plain lines, one a stage."""

    def __enter__(self) -> _Reporter:
        self._bar: Any = None
        self._stage: Stage | None = None
        return self

    def __call__(self, progress: Progress) -> None:
        if progress.stage is not self._stage:
            self._close()
            self._stage = progress.stage
            if sys.stderr.isatty() and progress.stage is not Stage.DONE:
                from tqdm import tqdm

                self._bar = tqdm(total=progress.of, desc=str(progress.stage), file=sys.stderr, leave=False)
            elif progress.stage is not Stage.DONE:
                print(f"graspd: {progress.stage} ({progress.elapsed:.1f} s)", file=sys.stderr)
        if self._bar is not None:
            self._bar.set_postfix_str(f"{progress.verified} verified" if progress.verified else f"{progress.best:.2f}")
            self._bar.update(progress.step - self._bar.n)

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _reconstruct(options: argparse.Namespace) -> int:
    from graspd_core.geometry.cloud import load_cloud
    from graspd_core.geometry.mesh import save_mesh
    from graspd_core.geometry.reconstruct import reconstruct
    from graspd_core.io import check_writable

    check_writable(options.out)
    cloud = load_cloud(options.cloud)
    mesh, warnings = reconstruct(cloud.points, viewpoint=tuple(cloud.viewpoint.tolist()))
    save_mesh(mesh, options.out)
    for warning in warnings:
        print(f"graspd: {warning}", file=sys.stderr)
    extent = mesh.vertices.max(0) - mesh.vertices.min(0)
    print(f"{options.out}: {len(mesh.faces)} faces, {' x '.join(f'{e * 1e3:.0f}' for e in extent)} mm")
    return EXIT_OK


def _hands(options: argparse.Namespace) -> int:
    import torch

    from graspd_core.pipeline import hand_names, load_hand

    torch.set_num_threads(1)
    for name in hand_names():
        hand = load_hand(name)
        print(f"{name}: {hand.num_joints} joints, {len(hand.candidate_points)} contact candidates, {hand.urdf}")
    return EXIT_OK


def _doctor(options: argparse.Namespace) -> int:
    from graspd_core import doctor

    return doctor.main()


if __name__ == "__main__":
    sys.exit(main())
