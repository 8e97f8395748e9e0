"""Three nodes of Ray in processes of this machine; one is killed when the first block is done. Run by test_ray_runs.py.

cluster_run.py OUT
"""

import json
import os
import secrets
import sys

# As `ray_running` has them, before Ray reads them.
os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}

from ray.cluster_utils import Cluster

from graspd_dataset.blocks import Block, DatasetRequest, blocks_of
from graspd_dataset.dataset_store import DatasetStore
from graspd_dataset.guarded_calls import Limits
from graspd_dataset.ray_engine import RayEngine, ray_running
from graspd_dataset.run_dataset import missing_blocks, run_blocks


def main(out: str) -> None:
    store = DatasetStore(out)
    request = DatasetRequest(
        ("shape:sphere",), hands=("parallel_gripper",), per_object=40, block=2, preset="fast", measure="none"
    )
    blocks = blocks_of(request)
    options = {"object_store_memory": 100 * 2**20, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **options})
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20) for _ in range(2)]
    reports = []
    with ray_running(cluster.address, None) as ray:
        engine = RayEngine(ray, store, Limits(), ship=True)
        slots = engine.slots()
        for what, report in run_blocks(missing_blocks(blocks, store), engine):
            if not isinstance(what, Block):
                continue
            reports.append(report)
            if len(reports) == 1:
                cluster.remove_node(nodes[0], allow_graceful=False)
    cluster.shutdown()
    print(json.dumps({"slots": slots, "failed": [r.failed for r in reports if r.failed], "reports": len(reports)}))


if __name__ == "__main__":
    main(sys.argv[1])
