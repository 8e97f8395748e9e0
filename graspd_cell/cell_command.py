"""`graspd cell`: a simulated arm empties a bin. Each pick prints one line, and a browser can show the cell."""

from __future__ import annotations

import argparse
import atexit
import gc
import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.options import add_address
from graspd_core.cli.output import answer, print_error, print_note, waiting
from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, Interrupt
from graspd_core.errors import ConfigError, GraspdError

if TYPE_CHECKING:
    from graspd_cell.cell_view import LiveCell
    from graspd_cell.picker import Attempt
    from graspd_cell.referee import Report
    from graspd_cell.simulated_robot import SimulatedRobot
    from graspd_core.arms.arm import Arm
    from graspd_core.hands.model import HandModel

# Exit status if an object did not end in the place bin.
EXIT_LEFT = 3
# Seconds that the page waits for a first visitor.
_PATIENCE = 20.0


def add_command(commands: Any) -> None:
    """Add the command `cell` to the parsers in `commands`."""
    parser = commands.add_parser("cell")
    parser.set_defaults(run=run)
    parser.add_argument("--arm", default="ur5e_like", metavar="NAME|PATH", help="default: ur5e_like")
    parser.add_argument("--hand", default="allegro_right", metavar="NAME|PATH", help="default: allegro_right")
    parser.add_argument(
        "--things", nargs="+", default=["families"], metavar="THING",
        help="family:NAME[:NUMBER] (irregular), shape:NAME, a mesh folder with a csv of masses (default: families)",
    )  # fmt: skip
    parser.add_argument("--count", type=int, default=5, metavar="N", help="things in the bin (default 5)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the things and of their fall (default 0)")
    parser.add_argument("--preset", default="balanced", help="graspd's preset (default balanced)")
    parser.add_argument("--attempts", type=int, default=None, metavar="N", help="at most N (default: 3 + 2 per thing)")
    parser.add_argument(
        "--picks", type=int, default=None, metavar="N", help="refill the bin until N attempts were made"
    )
    parser.add_argument("--film", type=Path, default=None, metavar="PATH.png", help="save 8 frames of the first pick")
    parser.add_argument("--view", action="store_true", help="show the cell in a browser, in real time")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="speed of --view (default 1: real time)")
    add_address(parser)


def run(options: argparse.Namespace) -> int:
    """Empty the bin. Return 0 if all objects are in the place bin, 3 if not, 130 after Ctrl-C."""
    import torch

    from graspd_cell.cell_view import Film, LiveCell
    from graspd_cell.grasp_source import InProcessGrasps, ReportingSource
    from graspd_cell.picker import Cancelled, Ending, Picker, summary
    from graspd_core.arms.arm import load_arm
    from graspd_core.hands.library import load_hand

    _refuse(options)
    torch.set_num_threads(1)
    # Unfreeze at exit. Frozen objects are never freed, and OMPL prints many warnings about such objects.
    atexit.register(gc.unfreeze)
    arm, hand = load_arm(options.arm), load_hand(options.hand)
    if options.picks is not None:
        return _many_picks(options, arm, hand)
    robot = _filled_cell(options, arm, hand, options.seed)
    world = robot.world
    live = LiveCell(robot, host=options.host, port=options.port, speed=options.speed) if options.view else None
    film = Film(robot) if options.film else None
    source = ReportingSource(
        InProcessGrasps(arm, hand, world.layout, preset=options.preset, seed=options.seed),
        lambda view, offer: live.show_offer(hand, view, offer) if live else None,
    )
    attempts: list[Attempt] = []
    with Interrupt() as interrupt:
        if live is not None:
            print_note(f"{live.page.url} - the arm starts when this page is open")
            live.page.wait_for_visitor(_PATIENCE, interrupt.is_interrupted)
        picker = Picker(robot, source, arm, hand, world.layout, cancelled=interrupt.is_interrupted)
        try:
            for attempt in waiting(picker.empty_the_bin(options.attempts or 2 * options.count + 3), "pick"):
                attempts.append(attempt)
                report = robot.referee()
                _tell(live, attempt, report)
                if film is not None and attempt.ending is Ending.PICKED:
                    film.save(options.film)
                    film = None
                elif film is not None:
                    film.begin()
        except Cancelled as error:
            print_error(error)
        finally:
            if live is not None:
                live.page.close()
    places = robot.referee().places
    left = [name for name, place in places.items() if place != world.layout.place.name]
    print(f"{summary(attempts)}; left: {', '.join(left) or 'nothing'}; {picker.why_ended or 'interrupted'}", flush=True)
    answer({"attempts": attempts, "left": left})
    if interrupt.is_interrupted():
        return EXIT_INTERRUPTED
    return EXIT_LEFT if left else EXIT_OK


def _filled_cell(options: argparse.Namespace, arm: Arm, hand: HandModel, seed: int) -> SimulatedRobot:
    """Return the robot of a cell whose bin holds objects at rest."""
    from graspd_cell.cell_study import CellCase
    from graspd_cell.simulated_robot import SETTLING, SimulatedRobot
    from graspd_cell.things import find_sources
    from graspd_cell.world import pile_cell

    found = () if options.things == ["families"] else find_sources(options.things)
    things = tuple((source.source, source.mass) for source in found)
    case = CellCase(f"{options.arm}+{options.hand}", options.count, seed, options.preset, things)
    robot = SimulatedRobot(pile_cell(arm, hand, case.sources(), seed), seed=seed)
    robot.wait(SETTLING)
    return robot


def _many_picks(options: argparse.Namespace, arm: Arm, hand: HandModel) -> int:
    """Empty bins until `--picks` attempts were made. Print failed attempts, the number of each outcome, and memory use.

    The first bin has the seed `--seed`. Each later bin has the next seed. Return the exit status.
    """
    from graspd_cell.grasp_source import InProcessGrasps
    from graspd_cell.picker import Attempt, Cancelled, Ending, Picker, summary
    from graspd_core.runtime.worker_process import resident_mb

    attempts, memory, ended = list[Attempt](), list[float](), Counter[str]()
    with Interrupt() as interrupt:
        # A bin may end without an attempt. The number of bins is limited too, so that the loop ends.
        while len(attempts) < options.picks and len(memory) < options.picks and not interrupt.is_interrupted():
            robot, number = _filled_cell(options, arm, hand, options.seed + len(memory)), len(memory) + 1
            source = InProcessGrasps(arm, hand, robot.world.layout, preset=options.preset, seed=options.seed)
            picker = Picker(robot, source, arm, hand, robot.world.layout, cancelled=interrupt.is_interrupted)
            most = min(options.attempts or 2 * options.count + 3, options.picks - len(attempts))
            try:
                for attempt in waiting(picker.empty_the_bin(most), "pick"):
                    attempts.append(attempt)
                    if attempt.ending is not Ending.PICKED:
                        print(f"bin {number}, attempt {attempt.number}: {attempt.ending}: {attempt.reason}", flush=True)
            except GraspdError as error:
                ended["the arm stayed where it was"] += not isinstance(error, Cancelled)
                print(f"bin {number}: {error}", flush=True)
            memory.append(resident_mb(os.getpid()))
    ended += Counter(str(attempt.ending) for attempt in attempts)
    print("; ".join(f"{ending}: {count}" for ending, count in ended.most_common()))
    told = f"{memory[0]:.0f} MB after the first bin, {memory[-1]:.0f} MB after the last" if memory else "no bin"
    print(f"{summary(attempts)}; {len(memory)} bins; {told}", flush=True)
    answer({"attempts": attempts, "endings": ended, "memory_mb": memory})
    return EXIT_INTERRUPTED if interrupt.is_interrupted() else EXIT_OK


def _refuse(options: argparse.Namespace) -> None:
    from graspd_cell.cell_study import MOST_THINGS
    from graspd_core.io.grasps_json import check_writable

    if not 1 <= options.count <= MOST_THINGS:
        raise ConfigError(f"--count: {options.count}; valid: 1 to {MOST_THINGS}")
    if not 0 <= options.seed < 2**31:
        raise ConfigError(f"--seed: {options.seed}; valid: 0 to 2^31 - 1")
    for name, value in (("attempts", options.attempts), ("picks", options.picks)):
        if value is not None and value < 1:
            raise ConfigError(f"--{name}: {value}; valid: 1 or more")
    if options.picks is not None and (options.view or options.film):
        raise ConfigError("--picks cannot be combined with --view or --film; remove one of them")
    if not 0 < options.speed < float("inf"):
        raise ConfigError(f"--speed: {options.speed}; valid: a positive number")
    if options.film is not None:
        check_writable(options.film)


def _tell(live: LiveCell | None, attempt: Attempt, report: Report) -> None:
    """Print one line about an attempt. The web page also gets the line, and the count of objects in the place bin."""
    out = sum(place == "place bin" for place in report.places.values())
    sure = "verified" if attempt.verified else "likely"
    chance = "" if attempt.probability is None else f" {attempt.probability:.2f}"
    reason = f": {attempt.reason}" if attempt.reason else ""
    line = (
        f"{attempt.number}: {attempt.ending}{reason}; {sure}{chance}; graspd {attempt.graspd_seconds:.1f} s, "
        f"arm {attempt.seconds:.1f} s; {out} of {len(report.places)} out"
    )
    print(line, flush=True)
    if live is not None:
        live.page.write(f"{out} of {len(report.places)} things out", line)
