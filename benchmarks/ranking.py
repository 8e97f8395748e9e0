"""Fit the score that candidates are tried in order of: `graspd_core/methods/stages/ranking.npz`.

    ranking.py read DATASET [--out results/ranking]
    ranking.py try [--objects shape:mug PATH ...] [--hands allegro_right ...] [--out results/ranking]
    ranking.py fit [--out results/ranking] [--held-out results/ranking-scans]

`read` takes the candidates of a data set (`graspd dataset`) and how their trials ended. Of those the last of a ranking
were never tried, so `try` finds more, 24 grasps' worth a block, of random size, friction and preset, and tries all; it
goes on where it was stopped. `fit` trains a network on both, leaves each object out in turn and each hand, tells what
its order is worth on what `try` found against the order by chance and by the linear score that it replaced, and writes
the network of all.
"""

from __future__ import annotations

import argparse
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import nn

from graspd_core import load_hand, load_scene
from graspd_core.bench.report import markdown_table
from graspd_core.bench.study import all_shapes
from graspd_core.methods.candidates import finished, staged
from graspd_core.methods.loop import Hooks
from graspd_core.methods.method_registry import METHODS
from graspd_core.methods.plan_config import load_preset
from graspd_core.methods.planner import PlannerInput
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import build_problem
from graspd_core.methods.stages.ranking import FARTHEST, log_odds, ranking_figures
from graspd_core.scene.scene import object_parts
from graspd_core.trials.hold_trial import hold_trial
from graspd_core.trials.world import PROTOCOLS, at_friction, build_world

HANDS = ("allegro_right", "leap_right", "barrett_like", "parallel_gripper")
PRESETS = ("balanced", "balanced", "fast", "accurate")
VARIANTS, COUNT = 3, 24
WIDTH, EPOCHS, BATCH, RATE, DECAY = 16, 30, 256, 3e-3, 0.1
# Candidates that one order is told by, and those of them that a robot would look at.
GROUP, FIRST, DRAWS = 32, 8, 40
# The linear score of the first five figures, by which candidates were ordered before.
LINEAR = (-1.7, -1.3, -0.7, -5.5)


def try_block(where: Path, source: str, hand_name: str, variant: int) -> None:
    """Candidates of one object, hand and variant, and how the trials of each ended."""
    name = "".join(c if c.isalnum() else "_" for c in f"{Path(source).stem}-{hand_name}-{variant}")
    file = where / f"{name}.npz"
    if file.exists():
        return
    rng = np.random.default_rng([variant, *source.encode(), *hand_name.encode()])
    preset, friction = PRESETS[rng.integers(len(PRESETS))], float(rng.choice([0.4, 0.6, 0.8]))
    scale = float(rng.uniform(0.6, 1.4)) if source.startswith("shape:") else 1.0
    config = load_preset(preset)
    hand = load_hand(hand_name, candidates=config.problem.fine_candidates)
    scene = load_scene(source, scale=scale, friction=friction, resolution=config.resolution)
    found = METHODS[config.method].plan(PlannerInput(scene, hand, COUNT, variant, config, Hooks()))
    some = staged(found.problem, hand, found.poses, config)
    grasps = finished(found.problem, hand, some)
    held = {}
    for trial in ("standard", "hard"):
        protocol = at_friction(PROTOCOLS[trial], friction)
        world = build_world(hand, scene.object, object_parts(scene.object), protocol)
        held[trial] = np.array([hold_trial(world, grasp, protocol).passed for grasp in grasps])
    figures = ranking_figures(found.problem, some).numpy()
    np.savez(file, figures=figures, object=source, hand=hand_name, preset=preset, **held)
    print(f"{name}: {preset}, {held['standard'].sum()} of {len(grasps)} hold, {held['hard'].sum()} the hard trial")


def read_dataset(where: Path, dataset: Path) -> None:
    """The candidates of a data set's objects and hands, a file a block, their figures computed anew."""
    keys = ["object_source", "scale", "friction", "hand_name", "preset"]
    postures = ["grasp_position", "grasp_quaternion_wxyz", "grasp_joint_positions"]
    frame = pd.read_parquet(dataset / "grasps", columns=[*keys, *postures, "joint_names", "verdict"])
    for number, (_, rows) in enumerate(frame.groupby(keys)):
        source, scale, friction, hand_name, preset = rows[keys].iloc[0]
        config = load_preset(preset)
        hand = load_hand(hand_name, candidates=config.problem.fine_candidates)
        scene = load_scene(source, scale=scale, friction=friction, resolution=config.resolution)
        problem = build_problem(scene, hand, config.problem, seed=0)
        order = [list(rows["joint_names"].iloc[0]).index(name) for name in hand.joint_names]
        at, turn, joints = (torch.as_tensor(np.stack(rows[name].to_list())).float() for name in postures)
        poses, figures = Poses(at, turn, joints[:, order]), []
        for some in torch.arange(len(at)).split(128):
            figures.append(ranking_figures(problem, staged(problem, hand, poses[some], config)).numpy())
        held = (rows["verdict"] == "verified").to_numpy()
        names = {"object": source, "hand": hand_name, "preset": preset}
        np.savez(where / f"dataset-{number}.npz", figures=np.concatenate(figures), standard=held, **names)


def fitted(figures: np.ndarray, held: np.ndarray, seed: int = 0) -> dict[str, np.ndarray]:
    """Mean and deviation of the figures, and the layers of a network that is trained on how trials ended."""
    torch.manual_seed(seed)
    mean, deviation = figures.mean(0), figures.std(0) + 1e-6
    x = torch.as_tensor(((figures - mean) / deviation).clip(-FARTHEST, FARTHEST), dtype=torch.float32)
    y = torch.as_tensor(held, dtype=torch.float32)
    sizes = (x.shape[1], WIDTH, WIDTH, 1)
    layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    network = nn.Sequential(layers[0], nn.SiLU(), layers[1], nn.SiLU(), layers[2])
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, EPOCHS * -(-len(x) // BATCH))
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(x)).split(BATCH):
            loss = nn.functional.binary_cross_entropy_with_logits(network(x[rows])[:, 0], y[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    parameters = {f"weight{i}": layer.weight.detach().numpy().T for i, layer in enumerate(layers)}
    parameters |= {f"bias{i}": layer.bias.detach().numpy() for i, layer in enumerate(layers)}
    return {"mean": mean.astype(np.float32), "deviation": deviation.astype(np.float32), **parameters}


def odds(network: dict[str, np.ndarray], figures: np.ndarray) -> np.ndarray:
    """Log-odds by a network."""
    tensors = {name: torch.as_tensor(values).double() for name, values in network.items()}
    return log_odds(tensors, torch.as_tensor(figures)).numpy()


def linear(figures: np.ndarray) -> np.ndarray:
    """The score before."""
    return figures[:, :4] @ LINEAR - 10.0 * (figures[:, 4] - 1.0).clip(0.0)


def worth(order: np.ndarray, held: np.ndarray, group: np.ndarray) -> tuple[float, float, float]:
    """Share of the first 8 of 32 that hold, trials for each of 8 verified, and the area under the ROC curve."""
    rng = np.random.default_rng(0)
    first, trials, area = [], [], []
    for name in np.unique(group):
        rows = np.flatnonzero(group == name)
        if len(rows) < GROUP:
            continue
        good, bad = order[rows][held[rows]], order[rows][~held[rows]]
        if len(good) and len(bad):
            area.append((good[:, None] > bad).mean() + 0.5 * (good[:, None] == bad).mean())
        for _ in range(DRAWS):
            drawn = rng.choice(rows, GROUP, replace=False)
            ended = held[drawn][np.argsort(-order[drawn], kind="stable")]
            found = np.cumsum(ended)
            first.append(ended[:FIRST].mean())
            took = np.argmax(found >= FIRST) + 1 if found[-1] >= FIRST else GROUP
            trials.append(took / max(min(FIRST, found[-1]), 1))
    return float(np.mean(first)), float(np.mean(trials)), float(np.mean(area))


def left_out(data: dict[str, np.ndarray], by: str) -> np.ndarray:
    """Log-odds of every candidate by a network that saw none with its object, or hand."""
    result = np.zeros(len(data["standard"]))
    for name in np.unique(data[by]):
        out = data[by] == name
        result[out] = odds(fitted(data["figures"][~out], data["standard"][~out]), data["figures"][out])
    return result


def read(folder: Path) -> dict[str, np.ndarray]:
    """All blocks of a folder, one row a candidate; those of a data set had no hard trial."""
    blocks = [dict(np.load(file)) for file in sorted(folder.glob("*.npz"))]
    sizes = [len(block["standard"]) for block in blocks]
    data = {name: np.concatenate([block[name] for block in blocks]) for name in ("figures", "standard")}
    data["hard"] = np.concatenate([block.get("hard", np.zeros(0, bool)) for block in blocks])
    data["all"] = np.repeat(["hard" in block for block in blocks], sizes)
    return data | {name: np.repeat([str(block[name]) for block in blocks], sizes) for name in ("object", "hand")}


def table(title: str, data: dict[str, np.ndarray], orders: dict[str, np.ndarray]) -> None:
    """Print what orders are worth, for all hands and for each, on what was tried whatever its rank."""
    some = data["all"]
    hands, objects, held = data["hand"][some], data["object"][some], {"standard": data["standard"][some]}
    held["hard"], group, rows = data["hard"], np.char.add(np.char.add(objects, " "), hands), []
    for hand in ("all", *np.unique(hands)):
        chosen = (hands == hand) | (hand == "all")
        for name, order in orders.items():
            for trial, ended in held.items():
                first, trials, area = worth(order[some][chosen], ended[chosen], group[chosen])
                rows.append([hand, name, trial, f"{first:.1%}", f"{trials:.2f}", f"{area:.3f}"])
    print(f"\n{title}: {some.sum()} candidates of all ranks, of {len(some)}\n")
    print(markdown_table(["hand", "order", "trial", "of the first 8 of 32 hold", "trials a verified one", "AUC"], rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("read", "try", "fit"))
    parser.add_argument("dataset", nargs="?", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(all_shapes()))
    parser.add_argument("--hands", nargs="+", default=list(HANDS))
    parser.add_argument("--variants", type=int, default=VARIANTS)
    parser.add_argument("--out", type=Path, default=Path("results/ranking"))
    parser.add_argument("--held-out", type=Path)
    parser.add_argument("--to", type=Path, default=Path("graspd_core/methods/stages/ranking.npz"))
    torch.set_num_threads(1)  # The networks are too small to be shared out.
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.what == "try":
        for variant in range(given.variants):
            for source, hand in product(given.objects, given.hands):
                try_block(given.out, source, hand, variant)
        return None
    if given.what == "read":
        return read_dataset(given.out, given.dataset)
    data = read(given.out)
    rng = np.random.default_rng(0)
    chance = {"chance": rng.random(len(data["standard"])), "linear": linear(data["figures"])}
    by = {f"network, {kind} left out": left_out(data, kind) for kind in ("object", "hand")}
    table("Shapes", data, chance | by)
    network = fitted(data["figures"], data["standard"])
    if given.held_out is not None:
        scans = read(given.held_out)
        table("Held out", scans, {"linear": linear(scans["figures"]), "network": odds(network, scans["figures"])})
    np.savez(given.to, **network)  # type: ignore[arg-type]
    print(f"\nwrote {given.to} ({given.to.stat().st_size} bytes)")


if __name__ == "__main__":
    main()
