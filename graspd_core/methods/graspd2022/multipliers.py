"""Constrained minimisation by gradient steps: the modified differential multiplier method, Adamax and Adam.

For min f(x) subject to g(x) < C the Lagrangian is f + λ c + d c² / 2 with c = max(g − C, 0); x descends it while λ
climbs it. The damping d c² / 2 makes the two settle instead of circling (Platt & Barr, NIPS 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_BETA1, _EPSILON = 0.9, 1e-8


@dataclass(frozen=True)
class Adamax:
    """A variable of every start and its moments (Kingma & Ba 2015, §7.1).

    Attributes:
        value: the iterate.
        mean: running mean of the gradient.
        top: decaying maximum of the gradient's size; with Adam the running mean of its squares.
    """

    value: Float[Tensor, "batch *shape"]
    mean: Float[Tensor, "batch *shape"]
    top: Float[Tensor, "batch *shape"]


def adamax(value: Float[Tensor, "batch *shape"]) -> Adamax:
    """The state before the first step."""
    return Adamax(value, torch.zeros_like(value), torch.zeros_like(value))


def adamax_step(
    state: Adamax, gradient: Float[Tensor, "batch *shape"], rate: float, count: int, memory: float = 0.999
) -> Adamax:
    """The state after step number `count`, from one; a negative rate climbs. `memory` keeps that share of `top`."""
    mean = torch.lerp(gradient, state.mean, _BETA1)
    top = torch.maximum(memory * state.top, gradient.abs())
    return Adamax(torch.addcdiv(state.value, mean, top + _EPSILON, value=-rate / (1 - _BETA1**count)), mean, top)


def adam_step(
    state: Adamax, gradient: Float[Tensor, "batch *shape"], rate: float, count: int, memory: float = 0.999
) -> Adamax:
    """The state after Adam's step number `count`, from one (Kingma & Ba 2015, §2); `memory` is its β2."""
    mean = torch.lerp(gradient, state.mean, _BETA1)
    squares = torch.lerp(gradient * gradient, state.top, memory)
    size = (squares / (1 - memory**count)).sqrt() + _EPSILON
    return Adamax(torch.addcdiv(state.value, mean, size, value=-rate / (1 - _BETA1**count)), mean, squares)


def excess(value: Float[Tensor, "*shape"], bound: float) -> Float[Tensor, "*shape"]:
    """By how much a constraint g < C is broken: max(g − C, 0). It is also the gradient of the Lagrangian in λ."""
    return (value - bound).clamp_min(0.0)


def damped(
    broken: Float[Tensor, "*shape"], multiplier: Float[Tensor, "*shape"], damping: float
) -> Float[Tensor, "*shape"]:
    """What a broken constraint adds to the Lagrangian: λ c + d c² / 2."""
    return broken * (multiplier + 0.5 * damping * broken)
