"""Samples of a hand on disk: the same as fresh ones, for that hand alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd_core.hands import self_collision, surface_points
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.hands.self_collision import adjacent_links
from graspd_core.hands.surface_points import candidates, dense_samples, kept_dense_samples, with_candidates
from graspd_core.runtime import disk_cache as cache


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("GRASPD_CACHE", raising=False)
    with_candidates.cache_clear()
    cache.forget()
    yield tmp_path / "graspd"
    with_candidates.cache_clear()
    cache.forget()


def arrays_of(hand):
    samples = kept_dense_samples(hand, count=500, seed=3)
    return [hand.adjacent, hand.candidate_points, hand.candidate_normals, hand.candidate_link, *samples]


@pytest.mark.parametrize("name", hand_names())
def test_what_is_on_disk_is_what_sampling_gives(name, own_cache, monkeypatch):
    hand = load_hand(name, candidates=100)
    fresh = arrays_of(hand)
    bare = replace(hand, adjacent=np.zeros_like(hand.adjacent))
    expected = [hand.adjacent, *candidates(hand, 100, 0), *dense_samples(hand, count=500, seed=3)]
    cache.forget()
    for module, function in ((surface_points, "candidates"), (surface_points, "dense_samples")):
        monkeypatch.setattr(module, function, lambda *_, **__: pytest.fail("sampled again"))
    monkeypatch.setattr(self_collision, "_adjacent_links", lambda _: pytest.fail("sampled again"))
    read = arrays_of(load_hand(name, candidates=100))
    assert adjacent_links(bare).tolist() == hand.adjacent.tolist()
    for a, b, c in zip(fresh, read, expected, strict=True):
        assert a.dtype == b.dtype == c.dtype
        assert (a == b).all()
        assert (b == c).all()


def test_another_hand_has_its_own(own_cache):
    hand = load_hand("parallel_gripper", candidates=50)
    files = set(own_cache.glob("hand-*.npz"))
    with_candidates(replace(hand, name="other", urdf="elsewhere"), 60)
    assert len(set(own_cache.glob("hand-*.npz")) - files) == 1
    solid = hand.primitives[0]
    thicker = replace(hand, primitives=(replace(solid, translation=solid.translation + 1e-6), *hand.primitives[1:]))
    for changed in (thicker, replace(hand, upper=hand.upper + 1e-6), replace(hand, palm_normal=-hand.palm_normal)):
        files = set(own_cache.glob("hand-*.npz"))
        with_candidates(changed, 60)
        assert len(set(own_cache.glob("hand-*.npz")) - files) == 1


@pytest.mark.parametrize("alien", [{"adjacent": np.zeros(3)}, {"adjacent": np.float64(1)}, {"other": np.zeros((9, 9))}])
def test_an_alien_file_is_sampled_again(alien, own_cache):
    hand = load_hand("parallel_gripper", candidates=50)
    bare = replace(hand, adjacent=np.zeros_like(hand.adjacent))
    adjacent_links(bare)
    for file in own_cache.glob("hand-*-adjacent-*.npz"):
        np.savez(file, **alien)
    cache.forget()
    assert adjacent_links(bare).tolist() == hand.adjacent.tolist()
