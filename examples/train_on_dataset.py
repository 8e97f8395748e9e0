"""Train a small network on a data set of `graspd dataset`: python examples/train_on_dataset.py DIR [HAND [EPOCHS]].

The network predicts whether a candidate holds, from the object's surface in the hand's frame and from the joints. A
quarter of the objects is held out. The program prints the fraction of their candidates that holds, and the same
fraction of the half that the network rates best.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

POINTS = 128


def surface(vertices: Sequence[np.ndarray], faces: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Return points drawn uniformly from the surface of a mesh, object frame [m]."""
    corners = np.stack(list(vertices))[np.stack(list(faces))]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weights = rng.dirichlet(np.ones(3), POINTS)
    return np.einsum("pc,pcx->px", weights, corners[rng.choice(len(area), POINTS, p=area / area.sum())])


def read(where: str, hand: str) -> tuple[Tensor, Tensor, Tensor, np.ndarray]:
    """Return for each candidate: object points in the hand's frame [m], joints, 1 if it held, and the object's hash."""
    rows = pd.read_parquet(f"{where}/grasps", filters=[("hand", "=", hand)])
    meshes, rng = pd.read_parquet(f"{where}/objects"), np.random.default_rng(0)
    columns = (meshes[name] for name in ("object_sha256", "vertices", "faces"))
    clouds = {name: surface(vertices, faces, rng) for name, vertices, faces in zip(*columns, strict=True)}
    turned = Rotation.from_quat(np.stack(list(rows.grasp_quaternion_wxyz)), scalar_first=True).as_matrix()
    points = np.stack([clouds[name] for name in rows.object_sha256]) - np.stack(list(rows.grasp_position))[:, None]
    joints = np.concatenate([np.stack(list(rows[f"{s}_joint_positions"])) for s in ("grasp", "squeeze")], axis=1)
    held = (rows.verdict == "verified").to_numpy()
    inputs, seen, held = (torch.tensor(values, dtype=torch.float32) for values in (points @ turned, joints, held))
    return inputs, seen, held, rows.object_sha256.to_numpy()


class Network(nn.Module):
    """Network that computes the logit of holding from the joints and the maximum of each feature over the points."""

    def __init__(self, joints: int) -> None:
        super().__init__()
        self.points = nn.Sequential(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 128))
        self.head = nn.Sequential(nn.Linear(128 + joints, 64), nn.ReLU(), nn.Linear(64, 1))

    def forward(self, points: Tensor, joints: Tensor) -> Tensor:
        # Use centimetres, because the initial weights suit inputs of about 1.
        features = self.points(100 * points).amax(1)
        return self.head(torch.cat([features, joints], dim=1)).squeeze(1)


def main(arguments: Sequence[str]) -> int:
    where, hand, epochs = [*arguments, *("dataset", "allegro_right", "20")[len(arguments) :]]
    torch.manual_seed(0)
    points, joints, held, objects = read(where, hand)
    names = sorted(set(objects))
    test = torch.tensor(np.isin(objects, names[:: 4 if len(names) > 3 else 2]))
    network = Network(joints.shape[1])
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    own = torch.nonzero(~test).squeeze(1)
    for _ in range(int(epochs)):
        for batch in own[torch.randperm(len(own))].split(256):
            loss = nn.functional.binary_cross_entropy_with_logits(network(points[batch], joints[batch]), held[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        best = network(points[test], joints[test]).argsort(descending=True)[: (int(test.sum()) + 1) // 2]
    print(f"trained on {len(own)} candidates, {int(test.sum())} of {len(set(objects[test.numpy()]))} objects held out")
    print(f"holds: {held[test].mean():.0%} of all, {held[test][best].mean():.0%} of the best half by the network")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
