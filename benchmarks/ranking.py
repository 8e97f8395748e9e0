"""Fit `graspd_core/optimize/ranking.npz`, the network whose score orders the candidates before their trials.

    ranking.py try [--objects shape:mug PATH ...] [--hands allegro_right ...] [--out results/ranking]
    ranking.py fit [--out results/ranking] [--held-out results/ranking-scans]

`try` finds the candidates of requests for 24 grasps, and tries all of them. Each request is a block. Mass, trial
friction and preset are random, and half of the objects stand on a table. A stopped `try` continues. Without --objects,
`try` uses the eleven shapes at 0.2 to 2 times their size, five kinds of large objects with thin walls and random sizes
(`hollow`), and the seven families of irregular objects that the study `cameras` does not use. `fit` writes a network
trained on all blocks. It also trains without each object and each hand in turn, and prints how well such networks order
the rest. For comparison, it prints a random order, the earlier linear score, and on --held-out the shipped network.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import nn

from graspd_bench.rendering.families import FAMILIES, PREFIX, draw_object
from graspd_bench.rendering.tabletop import moved, resting_pose
from graspd_bench.studies.cameras import CHOSEN_ON, FIRST_SEED
from graspd_bench.study import all_shapes
from graspd_core import load_hand, load_scene
from graspd_core.optimize import ranking
from graspd_core.optimize.candidates import PlannerInput, finished, staged
from graspd_core.optimize.loop import Hooks
from graspd_core.optimize.plan_config import load_preset, method_row
from graspd_core.optimize.ranking import FARTHEST, log_odds, ranking_figures
from graspd_core.perception.scene import Scene, object_parts
from graspd_core.types import Plane, TriangleMesh
from graspd_core.verify.hold_trial import hold_trial
from graspd_core.verify.world import PROTOCOLS, at_friction, build_world
from graspd_dataset.run_records import markdown_table

SHIPS = Path(ranking.__file__).with_suffix(".npz")
HANDS = ("allegro_right", "leap_right", "barrett_like", "parallel_gripper")
PRESETS = ("balanced", "balanced", "fast", "accurate")
HOLLOW = ("hollow:cup", "hollow:bowl", "hollow:tube", "hollow:carton", "hollow:tray")
IRREGULAR = tuple(PREFIX + name for name in FAMILIES if name in CHOSEN_ON)
VARIANTS, COUNT = 5, 24
# Ranges of sizes, relative to the shapes, and of masses, relative to the greatest plausible mass for the volume.
SCALES, MASSES = (0.2, 2.0), (0.05, 1.5)
WIDTH, EPOCHS, BATCH, RATE, DECAY = 32, 60, 256, 3e-3, 0.1
# `worth` draws `GROUP` candidates of an object and hand (or all if fewer), `DRAWS` times, and looks at the `FIRST`.
GROUP, FIRST, DRAWS = 32, 8, 40
# Number of best candidates of an object and hand that `told` looks at: as many as a plan would take.
BEST = 16
# Weights of the first four figures in the linear score, which ordered candidates in earlier versions.
LINEAR = (-1.7, -1.3, -0.7, -5.5)


def hollow(kind: str, rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a large object with walls of 2 to 4 mm, 6 to 30 cm across and 3 to 35 cm high [m]."""
    wall = rng.uniform(0.002, 0.004)
    if kind in ("hollow:cup", "hollow:bowl"):
        top, height = ((0.03, 0.14), (0.1, 0.3)) if kind == "hollow:cup" else ((0.08, 0.15), (0.04, 0.1))
        radius, high = rng.uniform(*top), rng.uniform(*height)
        foot = radius * rng.uniform(0.5, 1.0)
        profile = [(0, 0), (foot, 0), (radius, high), (radius - wall, high), (foot - wall, wall), (0, wall)]
        return trimesh.creation.revolve(np.array(profile), sections=64)
    if kind == "hollow:tube":
        radius = rng.uniform(0.03, 0.07)
        return trimesh.creation.annulus(radius - wall, radius, rng.uniform(0.2, 0.35))
    tall = (0.06, 0.2) if kind == "hollow:carton" else (0.03, 0.05)
    x, y, z = rng.uniform((0.1, 0.08, tall[0]), (0.28, 0.2, tall[1]))
    sides = [((wall, y, z), (s * (x - wall) / 2, 0, z / 2)) for s in (1, -1)]
    sides += [((x, wall, z), (0, s * (y - wall) / 2, z / 2)) for s in (1, -1)]
    plates = [((x, y, wall), (0, 0, wall / 2)), *sides]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in plates]
    joined: Any = trimesh.util.concatenate(boxes)
    return joined


def thing_scene(source: str, rng: np.random.Generator, friction: float, resolution: int) -> Scene:
    """Return the scene of a block's object: a shape of random size, a hollow or irregular object, or a mesh file."""
    if source in HOLLOW:
        made = hollow(source, rng)
        mesh = TriangleMesh(np.asarray(made.vertices), np.asarray(made.faces))
    elif source.startswith(PREFIX):
        mesh = draw_object(source.removeprefix(PREFIX), int(rng.integers(FIRST_SEED))).mesh
    else:
        scale = float(np.exp(rng.uniform(*np.log(SCALES)))) if source.startswith("shape:") else 1.0
        mesh = load_scene(source, scale=scale).object.mesh
    scene = load_scene(moved(mesh, resting_pose(mesh, rng)), friction=friction, resolution=resolution)
    thing = scene.object.at_mass(float(np.exp(rng.uniform(*np.log(MASSES)))) * scene.object.mass)
    table = Plane(np.array([0.0, 0.0, 1.0]), float(thing.mesh.vertices[:, 2].min()))
    return replace(scene, object=thing, support=table if rng.random() < 0.5 else None)


def try_block(where: Path, source: str, hand_name: str, variant: int, count: int) -> None:
    """Plan and try the candidates of an object, hand and variant. Write the network's inputs and the results."""
    name = "".join(c if c.isalnum() else "_" for c in f"{Path(source).stem}-{hand_name}-{variant}")
    file = where / f"{name}.npz"
    if file.exists():
        return
    rng = np.random.default_rng([variant, *source.encode(), *hand_name.encode()])
    preset, friction = PRESETS[rng.integers(len(PRESETS))], float(rng.choice([0.4, 0.6, 0.8]))
    config = load_preset(preset)
    hand = load_hand(hand_name, candidates=config.problem.fine_candidates)
    scene = thing_scene(source, rng, friction, config.resolution)
    task = PlannerInput(scene, hand, count, variant, config, Hooks())
    some = staged(task.problem, hand, method_row(config.method).plan(task).poses, config)
    grasps = finished(task.problem, hand, some)
    # Candidates that penetrate the table have the score −inf and are not tried.
    kept = np.flatnonzero([np.isfinite(grasp.score) for grasp in grasps])
    held = {}
    for trial in ("standard", "hard"):
        protocol = at_friction(PROTOCOLS[trial], friction)
        world = build_world(hand, scene.object, object_parts(scene.object), protocol)
        held[trial] = np.array([hold_trial(world, grasps[row], protocol).passed for row in kept], dtype=bool)
    figures = ranking_figures(task.problem, some).numpy()[kept]
    partial = file.with_suffix(".partial")
    with partial.open("wb") as out:
        np.savez(out, figures=figures, object=source, hand=hand_name, preset=preset, **held)
    partial.rename(file)
    print(f"{name}: {preset}, {held['standard'].sum()} of {len(kept)} hold, {held['hard'].sum()} the hard trial")


def fitted(data: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Train a network on the candidates `rows`. Return mean and deviation of the inputs, and the network's layers.

    Training predicts the standard and the hard trial, so that both shape the layers. The second output is not kept.
    """
    torch.manual_seed(0)
    figures, held = data["figures"][rows], np.stack([data["standard"][rows], data["hard"][rows]], 1)
    mean, deviation = figures.mean(0), figures.std(0) + 1e-6
    x = torch.as_tensor(((figures - mean) / deviation).clip(-FARTHEST, FARTHEST), dtype=torch.float32)
    y = torch.as_tensor(held, dtype=torch.float32)
    sizes = (x.shape[1], WIDTH, WIDTH, 2)
    layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    network = nn.Sequential(layers[0], nn.SiLU(), layers[1], nn.SiLU(), layers[2])
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, EPOCHS * -(-len(x) // BATCH))
    for _ in range(EPOCHS):
        for some in torch.randperm(len(x)).split(BATCH):
            loss = nn.functional.binary_cross_entropy_with_logits(network(x[some]), y[some])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    parameters = {f"weight{i}": layer.weight.detach().numpy().T for i, layer in enumerate(layers)}
    parameters |= {f"bias{i}": layer.bias.detach().numpy() for i, layer in enumerate(layers)}
    parameters |= {"weight2": parameters["weight2"][:, :1], "bias2": parameters["bias2"][:1]}
    return {"mean": mean.astype(np.float32), "deviation": deviation.astype(np.float32), **parameters}


def odds(network: dict[str, np.ndarray], figures: np.ndarray) -> np.ndarray:
    """Return the log-odds that a network predicts."""
    tensors = {name: torch.as_tensor(values).double() for name, values in network.items()}
    return log_odds(tensors, torch.as_tensor(figures)).numpy()


def linear(figures: np.ndarray) -> np.ndarray:
    """Return the linear score of earlier versions."""
    return figures[:, :4] @ LINEAR - 10.0 * (figures[:, 4] - 1.0).clip(0.0)


def worth(order: np.ndarray, held: np.ndarray, group: np.ndarray) -> tuple[float, float, float]:
    """Return how good an order is: fraction of its first 8 of 32 that holds, trials per verified grasp, area under ROC.

    The trials of 32 candidates end when 8 hold.
    """
    rng = np.random.default_rng(0)
    first, trials, area = [], [], []
    for name in np.unique(group):
        rows = np.flatnonzero(group == name)
        good, bad = order[rows][held[rows]], order[rows][~held[rows]]
        if len(good) and len(bad):
            area.append((good[:, None] > bad).mean() + 0.5 * (good[:, None] == bad).mean())
        for _ in range(DRAWS):
            drawn = rng.choice(rows, min(GROUP, len(rows)), replace=False)
            ended = held[drawn][np.argsort(-order[drawn], kind="stable")]
            found = np.cumsum(ended)
            first.append(ended[:FIRST].mean())
            took = np.argmax(found >= FIRST) + 1 if found[-1] >= FIRST else len(drawn)
            trials.append(took / max(min(FIRST, found[-1]), 1))
    return float(np.mean(first)), float(np.mean(trials)), float(np.mean(area or [np.nan]))


def left_out(data: dict[str, np.ndarray], by: str) -> np.ndarray:
    """Return the log-odds of every candidate by a network trained without the candidate's object (or hand)."""
    result = np.zeros(len(data["standard"]))
    for name in np.unique(data[by]):
        out = data[by] == name
        result[out] = odds(fitted(data, ~out), data["figures"][out])
    return result


def read(folder: Path) -> dict[str, np.ndarray]:
    """Read all blocks of a folder. Each row is one candidate."""
    blocks = [dict(np.load(file)) for file in sorted(folder.glob("*.npz"))]
    if not blocks:
        raise SystemExit(f"{folder} has no blocks: `ranking.py try --out {folder}` makes them")
    sizes = [len(block["standard"]) for block in blocks]
    data = {name: np.concatenate([block[name] for block in blocks]) for name in ("figures", "standard", "hard")}
    return data | {name: np.repeat([str(block[name]) for block in blocks], sizes) for name in ("object", "hand")}


def told(title: str, data: dict[str, np.ndarray], log_odds: np.ndarray) -> None:
    """Print which share of the best candidates should hold according to the network, and which share held."""
    group = np.char.add(np.char.add(data["object"], " "), data["hand"])
    blocks = [np.flatnonzero(group == name) for name in np.unique(group)]
    best = [rows[np.argsort(-log_odds[rows], kind="stable")[:BEST]] for rows in blocks]
    expected = np.mean([(1 / (1 + np.exp(-log_odds[rows]))).mean() for rows in best])
    held = np.mean([data["standard"][rows].mean() for rows in best])
    print(f"{title}: of the best {BEST} of each object and hand {expected:.1%} should hold, {held:.1%} do")


def table(title: str, data: dict[str, np.ndarray], orders: dict[str, np.ndarray]) -> None:
    """Print the values of `worth` for every order, for all hands together and for each hand."""
    group, rows = np.char.add(np.char.add(data["object"], " "), data["hand"]), []
    for hand in ("all", *np.unique(data["hand"])):
        chosen = (data["hand"] == hand) | (hand == "all")
        for name, order in orders.items():
            for trial in ("standard", "hard"):
                first, trials, area = worth(order[chosen], data[trial][chosen], group[chosen])
                rows.append([hand, name, trial, f"{first:.1%}", f"{trials:.2f}", f"{area:.3f}"])
    print(f"\n{title}: {len(group)} candidates\n")
    print(markdown_table(["hand", "order", "trial", "of the first 8 of 32 hold", "trials a verified one", "AUC"], rows))


def by_others(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the scores that the network is compared with: random numbers and the linear score."""
    return {"chance": np.random.default_rng(0).random(len(data["standard"])), "linear": linear(data["figures"])}


def fit(folder: Path, held_out: Path | None, to: Path) -> None:
    """Train a network on a folder's blocks, print how good its order is, and write the network to `to`."""
    data, ships = read(folder), dict(np.load(SHIPS))
    kinds = [kind for kind in ("object", "hand") if len(np.unique(data[kind])) > 1]
    unseen = {f"network, {kind} left out": left_out(data, kind) for kind in kinds}
    table("Tried", data, by_others(data) | unseen)
    network = fitted(data, np.ones(len(data["figures"]), bool))
    others = read(held_out) if held_out is not None else None
    if others is not None:
        unseen = {"network before": odds(ships, others["figures"]), "network": odds(network, others["figures"])}
        table("Held out", others, by_others(others) | unseen)
    print()
    for name, order in unseen.items():
        told(name, data if others is None else others, order)
    np.savez(to, **network)  # type: ignore[arg-type]
    print(f"\nwrote {to} ({to.stat().st_size} bytes)")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("try", "fit"))
    parser.add_argument("--objects", nargs="+", default=[*all_shapes(), *HOLLOW, *IRREGULAR])
    parser.add_argument("--hands", nargs="+", default=list(HANDS))
    parser.add_argument("--variants", type=int, default=VARIANTS)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--out", type=Path, default=Path("results/ranking"))
    parser.add_argument("--held-out", type=Path)
    parser.add_argument("--to", type=Path, default=SHIPS)
    given = parser.parse_args(arguments)
    if given.what == "fit":
        return fit(given.out, given.held_out, given.to)
    given.out.mkdir(parents=True, exist_ok=True)
    for variant in range(given.variants):
        for source, hand in product(given.objects, given.hands):
            try_block(given.out, source, hand, variant, given.count)
    return None


if __name__ == "__main__":
    torch.set_num_threads(1)  # The networks are too small for several threads.
    main()
