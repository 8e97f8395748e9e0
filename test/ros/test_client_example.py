"""The example of a client talks to a node over DDS."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "ros_client.py"


def ask(client, mesh: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(client.domain)}
    return subprocess.run([sys.executable, EXAMPLE, mesh], env=environment, capture_output=True, text=True)


def test_the_client_prints_verified_grasps(node, client):
    done = ask(client, "sphere.obj")
    assert done.returncode == 0, done.stderr
    assert "verified" in done.stdout
    assert "#0 " in done.stdout
    assert "pressing towards" in done.stdout


def test_the_client_says_why_there_is_none(node, client):
    done = ask(client, "nothing.obj")
    assert done.returncode == 1
    assert "nothing.obj" in done.stdout + done.stderr
