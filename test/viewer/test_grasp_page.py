"""The page of `--html` in a real browser, and the picture of `--picture`: what is seen, and what a visitor chooses."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from graspd_core import load_hand, load_scene, make_shape
from graspd_viewer.grasp_page import best_view, save_picture, save_view

HAND = load_hand("parallel_gripper")


def shares(picture: np.ndarray) -> tuple[float, float, float]:
    """Shares of pixels that are the object's orange, the hand's blue grey, and the contacts' bright blue."""
    red, green, blue = (picture[..., channel].astype(float) for channel in range(3))
    contacts = (blue > 100) & (blue > 1.5 * green) & (blue > 2 * red)
    return float((red > 1.2 * blue).mean()), float(((blue > 1.2 * red) & ~contacts).mean()), float(contacts.mean())


def seen(page) -> np.ndarray:
    """The scene beside the legend, whose boxes have colours of their own."""
    taken = page.tab.screenshot(clip={"x": 380, "y": 100, "width": 480, "height": 500})
    return np.asarray(Image.open(io.BytesIO(taken)).convert("RGB"), dtype=float)


@pytest.fixture
def page(result, visit, tmp_path: Path):
    save_view(tmp_path / "view.html", load_scene("shape:box").object.mesh, HAND, result.grasps, name="box </script>")
    page = visit((tmp_path / "view.html").as_uri())
    page.tab.wait_for_selector("body[data-ready]", state="attached")
    return page


def test_the_page_opens_where_object_and_hand_are_seen(page):
    assert page.tab.title() == "box </script>, parallel_gripper: verified grasp"
    page.text("box </script>, parallel_gripper")
    page.until(lambda: min(shares(seen(page))[:2]) > 0.05)
    # Lit: a black page would be darker.
    picture = seen(page)
    assert np.median(picture[(picture < 250).any(-1)].max(-1)) > 120


def test_a_visitor_chooses_what_is_shown(page):
    # The one that failed is not among them.
    options = page.tab.locator("#choice option").all_text_contents()
    assert [text.split(",")[0] for text in options] == ["✓ #0 verified", "✓ #1 verified", "✓ #2 verified"]
    page.until(lambda: shares(seen(page))[2] > 0.0005)
    before = seen(page)
    page.tab.select_option("#choice", "1")
    page.until(lambda: np.abs(seen(page) - before).max() > 50)
    page.tab.get_by_label("contacts, with the object's normals").uncheck()
    page.until(lambda: shares(seen(page))[2] < 0.0005)
    page.tab.get_by_label("hand at the grasp").uncheck()
    page.until(lambda: shares(seen(page))[1] < 0.001)
    page.tab.get_by_label("hand at the pregrasp").check()
    page.until(lambda: (np.ptp(seen(page), axis=-1) < 40).mean() < 0.999 and shares(seen(page))[0] > 0.02)


def test_the_hand_does_not_hide_the_object():
    """A plate close above the object, as large as the object is: seen from the side."""
    box = make_shape("box")
    plate = replace(box, vertices=box.vertices * [2.0, 2.0, 0.05] + [0.0, 0.0, 0.1])
    eye, target, up = best_view(box, plate)
    assert abs(eye - target)[2] < 0.7 * np.linalg.norm(eye - target)
    sideways = best_view(box, plate, np.array([1.0, 0.0, 0.0]))
    assert sideways[2] == pytest.approx([1.0, 0.0, 0.0])
    assert up == pytest.approx([0.0, 0.0, 1.0])


def test_the_picture_shows_object_hand_and_contacts(result, tmp_path: Path):
    mesh = load_scene("shape:box").object.mesh
    save_picture(tmp_path / "grasp.png", mesh, HAND, result.grasps)
    with Image.open(tmp_path / "grasp.png") as image:
        object_share, hand_share, contact_share = shares(np.asarray(image))
    assert min(object_share, hand_share) > 0.03
    assert contact_share > 0.0005
    # If all failed, the object alone.
    save_picture(tmp_path / "none.png", mesh, HAND, result.failed)
    with Image.open(tmp_path / "none.png") as image:
        assert shares(np.asarray(image))[1:] == (0.0, 0.0)
