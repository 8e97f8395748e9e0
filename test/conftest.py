"""Switched on for every test: array shapes checked at run time, one torch thread, reproducible Hypothesis draws."""

from __future__ import annotations

import os

import hypothesis
from jaxtyping import install_import_hook

# Before anything imports graspd_core, or its functions would stay unchecked.
install_import_hook("graspd_core", "beartype.beartype")

import torch  # noqa: E402

torch.set_num_threads(1)

hypothesis.settings.register_profile("dev", deadline=None, max_examples=25)
hypothesis.settings.register_profile("ci", deadline=None, max_examples=25, derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "dev")
