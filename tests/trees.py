"""Machines at random."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def numbers(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def random_mjcf(seed: int, sizes: int = 5) -> str:
    """A tree of hinges and slides at random poses, with armature and damping; of 2 joints, and of
    one more with each seed, in turns of `sizes`."""
    rng = np.random.default_rng(seed)
    count = 2 + seed % sizes
    return _mjcf(rng, [int(rng.integers(max(0, j - 3), j)) for j in range(1, count)])


def chain_mjcf(seed: int, count: int) -> str:
    """Likewise, each joint on the one before."""
    return _mjcf(np.random.default_rng(seed), list(range(count - 1)))


def _mjcf(rng: np.random.Generator, parents: list[int]) -> str:
    """`parents` of all joints but the first."""
    children: list[list[int]] = [[] for _ in range(len(parents) + 1)]
    for j, parent in enumerate(parents, 1):
        children[parent].append(j)

    def body(j: int) -> str:
        kind = "slide" if rng.random() < 0.4 else "hinge"
        a, b, c = rng.uniform(0.002, 0.02, 3)
        inertia = np.array([a + b, b + c, c + a])  # any solid body's obeys the triangle inequality
        return (
            f'<body name="b{j}" pos="{numbers(rng.uniform(-0.4, 0.4, 3))}" '
            f'quat="{numbers(rng.normal(size=4))}">'
            f'<inertial pos="{numbers(rng.uniform(-0.2, 0.2, 3))}" mass="{rng.uniform(0.3, 2)}" '
            f'quat="{numbers(rng.normal(size=4))}" diaginertia="{numbers(inertia)}"/>'
            f'<joint name="j{j}" type="{kind}" axis="{numbers(rng.normal(size=3))}" '
            f'pos="{numbers(rng.uniform(-0.1, 0.1, 3))}" '
            f'armature="{rng.uniform(0.001, 0.05)}" damping="{rng.uniform(0, 0.5)}"/>'
            + "".join(body(child) for child in children[j])
            + "</body>"
        )

    return (
        '<mujoco><option gravity="0.3 -0.8 -9.81"/><compiler angle="radian"/><worldbody>'
        + body(0)
        + "</worldbody></mujoco>"
    )
