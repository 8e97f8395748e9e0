"""The shipped arms, loaded once."""

import pytest

from graspd_core.arms.arm import Arm, arm_names, load_arm


@pytest.fixture(scope="session", params=arm_names())
def arm(request: pytest.FixtureRequest) -> Arm:
    """Each shipped arm."""
    return load_arm(request.param)


@pytest.fixture(scope="session")
def ur() -> Arm:
    """The arm of six axes."""
    return load_arm("ur5e_like")
