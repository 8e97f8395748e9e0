"""A real browser, and a page with grasps of a gripper on a box, one of which fails its trial."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from graspd_core import Grasp, GraspResult, load_hand, load_preset, load_scene, plan_grasps, save_result
from graspd_core.perception.scene import object_parts
from graspd_core.verify.trial_registry import build_worlds, grasp_trials
from graspd_core.verify.world import PROTOCOLS

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
PATIENCE = 20_000  # milliseconds until what is waited for is held to never come


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Starting a browser on a busy machine takes its time."""
    for item in items:
        if "test/viewer" in item.path.as_posix() and "visit" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.timeout(300))


@pytest.fixture(scope="session")
def browser(result) -> Iterator[Any]:
    """Chromium from the system's packages, without a window.

    Behind `result`, which imports what plans: with playwright's greenlets about, Python 3.11 fails to compile modules.
    """
    del result
    pytest.importorskip("viser", reason="viser is not installed: pip install 'graspd[view]'")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.skip("no Chromium on the PATH: apt-get install chromium")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@dataclass
class Page:
    """One visitor of one page.

    Attributes:
        tab: playwright's page.
        errors: what its console said.
    """

    tab: Any
    errors: list[str] = field(default_factory=list)

    def text(self, text: str | re.Pattern[str]) -> None:
        """Wait until the page says so, in the tab that is in front."""
        self.tab.get_by_text(text).filter(visible=True).first.wait_for(timeout=PATIENCE)

    def choose(self, label: str, option: str) -> None:
        """Pick an option of the dropdown behind a label."""
        self.widget(label).click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def widget(self, label: str) -> Any:
        """The input behind a label."""
        return self.tab.locator(
            f"xpath=//label[normalize-space()='{label}']/ancestor::div[3]//input[not(@type='hidden')]"
        ).last

    def set(self, label: str, value: float) -> None:
        """Type a number beside a slider."""
        self.widget(label).fill(str(value))
        self.widget(label).press("Enter")

    def press(self, button: str) -> None:
        self.tab.get_by_role("button", name=button, exact=True).click()

    def key(self, key: str) -> None:
        """Press a key over the scene."""
        self.tab.mouse.click(300, 650)
        self.tab.keyboard.press(key)

    def picture(self) -> np.ndarray:
        """The scene, without the panel beside it."""
        taken = self.tab.screenshot(clip={"x": 20, "y": 160, "width": 500, "height": 400})
        return np.asarray(Image.open(io.BytesIO(taken)).convert("RGB"), dtype=float)

    def until(self, true: Callable[[], Any]) -> None:
        """Wait until something holds."""
        for _ in range(PATIENCE // 100):
            if true():
                return
            self.tab.wait_for_timeout(100)
        raise AssertionError("never came to hold")


@pytest.fixture
def visit(browser) -> Iterator[Callable[[str], Page]]:
    """Opens pages; they say nothing is wrong when the test ends."""
    pages: list[Page] = []

    def open_page(url: str) -> Page:
        page = Page(browser.new_page(viewport={"width": 880, "height": 700}))
        page.tab.on("console", lambda m: page.errors.append(m.text) if m.type == "error" else None)
        page.tab.on("pageerror", lambda error: page.errors.append(str(error)))
        page.tab.goto(url)
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.tab.close()
        assert page.errors == []


@pytest.fixture(scope="session")
def result() -> GraspResult:
    """Grasps of the gripper on the box; of the last, the hand is 15 cm away, and its trial says so."""
    scene, hand = load_scene("shape:box"), load_hand("parallel_gripper")
    found = plan_grasps(scene, hand, count=3, preset="fast", measure=True)
    best = found.tried[0]
    outward = best.grasp.position / np.linalg.norm(best.grasp.position)

    def away(grasp: Grasp) -> Grasp:
        move = {
            name: replace(getattr(grasp, name), position=getattr(grasp, name).position + 0.15 * outward)
            for name in ("pregrasp", "grasp", "squeeze")
        }
        return replace(grasp, **move, metrics=None)

    worlds = build_worlds(scene, hand, object_parts(scene.object), PROTOCOLS["standard"])
    bad = replace(away(best), trials=grasp_trials(worlds, away(best)))
    return replace(found, tried=(*found.tried[:3], bad))


@pytest.fixture(scope="session")
def grasps_file(result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "grasps.json"
    scene = load_scene("shape:box")
    save_result(path, result, scene.object, load_hand("parallel_gripper"), load_preset("fast"))
    return path


@pytest.fixture
def viewer() -> Iterator[Any]:
    """A page on a free port that nothing is shown on yet."""
    pytest.importorskip("viser", reason="viser is not installed: pip install 'graspd[view]'")
    from graspd_viewer.viewer import Viewer

    viewer = Viewer(port=0)
    yield viewer
    viewer.close()
