"""Processes that soak.py starts: a node that measures its own delays, a camera, and a control process.

`python soak_parts.py node|camera|control ...`
"""

from __future__ import annotations

import array
import json
import sys
import time
from pathlib import Path

import numpy as np

TIMER_PERIOD = 0.02  # seconds
FLUSH_PERIOD = 5.0
CAMERA_RATE = 30.0  # Hz
WIDTH, HEIGHT, FOCAL = 640, 480, 600.0  # pixels
BALL, RADIUS, NOISE = np.array([0.0, 0.0, 0.5]), 0.035, 0.0005  # metres


def run_node(file: Path, arguments: list[str]) -> int:
    """Run graspd_node. Append the lateness of a timer and the age of each arriving cloud to `file` [s]."""
    from graspd_ros import grasp_node as service
    from graspd_ros import node
    from graspd_ros.convert import nanoseconds
    from graspd_ros.inputs.sensor_frames import SensorFrame

    class TimedNode(service.GraspNode):
        def __init__(self, *args, **kwargs) -> None:
            self.late: list[float] = []
            self.ages: list[float] = []
            self._due = 0.0
            super().__init__(*args, **kwargs)
            self.create_timer(TIMER_PERIOD, self._on_tick)
            self.create_timer(FLUSH_PERIOD, self._flush)

        def _on_tick(self) -> None:
            now = time.monotonic()
            if self._due:
                self.late.append(max(now - self._due, 0.0))
            # The next tick is due one period after this tick. The timer skips missed ticks, so a stall counts once.
            self._due = now + TIMER_PERIOD

        def _see(self, sensor_frame: SensorFrame) -> None:
            self.ages.append((sensor_frame.arrived - nanoseconds(sensor_frame.stamp)) * 1e-9)
            super()._see(sensor_frame)

        def _flush(self) -> None:
            with file.open("a") as stream:
                stream.write(json.dumps({"late": self.late, "ages": self.ages}) + "\n")
            self.late, self.ages = [], []

    service.GraspNode = TimedNode
    sys.argv[1:] = arguments
    return node.main()


def run_camera(seconds: float) -> None:
    """Publish noisy organised clouds of a ball, 9.8 MB each, with best-effort QoS like an RGB-D camera's driver."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2, PointField

    rclpy.init()
    node = rclpy.create_node("soak_camera")
    publisher = node.create_publisher(PointCloud2, "/points", qos_profile_sensor_data)
    fields = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate("xyz")]
    fields.append(PointField(name="rgb", offset=16, datatype=PointField.FLOAT32, count=1))
    message = PointCloud2(height=HEIGHT, width=WIDTH, fields=fields, point_step=32, row_step=32 * WIDTH, is_dense=False)
    message.header.frame_id = "camera"
    clouds = [ball_cloud(seed) for seed in range(30)]
    end, number = time.monotonic() + seconds, 0
    due = time.monotonic()
    while time.monotonic() < end:
        message.data = clouds[number % len(clouds)]
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)
        number += 1
        due = max(due + 1 / CAMERA_RATE, time.monotonic() - 1.0)
        time.sleep(max(due - time.monotonic(), 0.0))
    print(number)
    node.destroy_node()
    rclpy.shutdown()


def run_control(seconds: float) -> None:
    """Sleep again and again for the node's timer period. Print how late the process woke each time [s]."""
    late: list[float] = []
    end = time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        time.sleep(TIMER_PERIOD)
        late.append(max(time.monotonic() - now - TIMER_PERIOD, 0.0))
    print(json.dumps(late))


def ball_cloud(seed: int) -> array.array:
    """Return the bytes of one organised cloud. Pixels beside the ball are NaN."""
    u, v = np.meshgrid((np.arange(WIDTH) - WIDTH / 2) / FOCAL, (np.arange(HEIGHT) - HEIGHT / 2) / FOCAL)
    rays = np.stack([u, v, np.ones_like(u)], -1)
    a, b, c = (rays**2).sum(-1), rays @ BALL, BALL @ BALL - RADIUS**2
    inside = b**2 - a * c
    with np.errstate(invalid="ignore"):
        depth = (b - np.sqrt(inside)) / a + np.random.default_rng(seed).normal(0, NOISE, a.shape)
    cloud = np.zeros((HEIGHT, WIDTH, 8), "<f4")
    cloud[..., :3] = rays * depth[..., None]
    return array.array("B", cloud.tobytes())


if __name__ == "__main__":
    if sys.argv[1] == "node":
        sys.exit(run_node(Path(sys.argv[2]), sys.argv[3:]))
    {"camera": run_camera, "control": run_control}[sys.argv[1]](float(sys.argv[2]))
