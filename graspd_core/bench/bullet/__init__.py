"""The second simulator: PyBullet."""
