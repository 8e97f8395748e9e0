"""A node like any other, but it warms up again and again until it stops. Started by test_node_process.py."""

import sys

from graspd_core import HandModel
from graspd_core.types import StopHook
from graspd_ros import grasp_node
from graspd_ros.node import main

honest = grasp_node.warm_up


def endless(hand: HandModel, stop: StopHook) -> None:
    while not stop():
        honest(hand, stop=stop)


if __name__ == "__main__":
    grasp_node.warm_up = endless
    sys.exit(main())
