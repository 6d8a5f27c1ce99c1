"""Rigid-body dynamics as CasADi expressions, by walking a `pin.Model`.

PyPI's `pin` has no CasADi scalar, so the two recursions are written out here for trees of
one-degree-of-freedom joints; pin's own numeric algorithms are their oracle in the tests.
Notation and algorithms: R. Featherstone, Rigid Body Dynamics Algorithms, Springer 2008, tables 5.1
(RNEA) and 7.1 (ABA). Spatial vectors are [linear; angular] as in pin.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from headway.models.coupling import Coupling


def _skew(p: Any) -> Any:
    return ca.vertcat(
        ca.horzcat(0, -p[2], p[1]), ca.horzcat(p[2], 0, -p[0]), ca.horzcat(-p[1], p[0], 0)
    )


def _motion_from_parent(rotation: Any, translation: Any) -> Any:
    """6x6 map of motion vectors from the parent's frame into the child's."""
    turned = rotation.T
    return ca.blockcat([[turned, -turned @ _skew(translation)], [ca.SX(3, 3), turned]])


def _cross_motion(v: Any) -> Any:
    return ca.blockcat([[_skew(v[3:6]), _skew(v[0:3])], [ca.SX(3, 3), _skew(v[3:6])]])


def _cross_force(v: Any) -> Any:
    return -_cross_motion(v).T


class Tree:
    """A fixed-base tree of revolute and prismatic joints, as numbers for the recursions.

    All functions of this module are of the axes that move its joints (see coupling.py): q, v, a and
    torques are theirs. Raises ValueError for a joint with more than one degree of freedom.
    """

    def __init__(self, model: pin.Model, coupling: Coupling | None = None) -> None:
        """`coupling`: None for a motor at each joint."""
        self.count = model.njoints - 1
        if model.nq != self.count or model.nv != self.count:
            many = [
                model.names[j]
                for j in range(1, model.njoints)
                if model.joints[j].nq != 1 or model.joints[j].nv != 1
            ]
            raise ValueError(
                f"joint {', '.join(many)}: only hinge and slide joints are supported; "
                "replace a free or ball joint by hinges and slides"
            )
        self.parent = [int(model.parents[j + 1]) - 1 for j in range(self.count)]
        self.placement = [model.jointPlacements[j + 1] for j in range(self.count)]
        self.axis = [
            np.array(model.joints[j + 1].createData().S).ravel() for j in range(self.count)
        ]
        self.inertia = [np.array(model.inertias[j + 1].matrix()) for j in range(self.count)]
        self.armature = np.array(model.armature)
        self.damping = np.array(model.damping)
        self.mass = [float(model.inertias[j + 1].mass) for j in range(self.count)]
        self.lever = [np.array(model.inertias[j + 1].lever) for j in range(self.count)]
        self.gravity = np.array(model.gravity.vector)
        coupling = coupling or Coupling.of(None, self.count)
        self.axes_by_joints = ca.sparsify(ca.DM(coupling.axes_by_joints))
        self.joints_by_axes = ca.sparsify(ca.DM(coupling.joints_by_axes))

    def placed(self, joint: int, q: Any) -> tuple[Any, Any]:
        """Rotation (3, 3) and origin (3, 1) of joint `joint`'s frame in its parent's, at coordinate
        q."""
        axis, place = self.axis[joint], self.placement[joint]
        if np.any(axis[3:]):  # revolute: Rodrigues' formula
            skew = np.array(pin.skew(axis[3:]))
            turn = ca.SX(np.eye(3)) + ca.sin(q) * skew + (1 - ca.cos(q)) * (skew @ skew)
            return place.rotation @ turn, ca.SX(place.translation)
        return ca.SX(place.rotation), place.translation + place.rotation @ axis[:3] * q

    def transform(self, joint: int, q: Any) -> Any:
        """Motion transform into joint `joint`'s frame from its parent's, at coordinate q."""
        return _motion_from_parent(*self.placed(joint, q))

    def poses(self, q: Any) -> list[tuple[Any, Any]]:
        """Rotation and origin of every joint's frame in the world."""
        poses: list[tuple[Any, Any]] = []
        q = self.joints_by_axes @ q
        for joint, parent in enumerate(self.parent):
            rotation, origin = self.placed(joint, q[joint])
            if parent >= 0:
                of_parent, at_parent = poses[parent]
                rotation, origin = of_parent @ rotation, at_parent + of_parent @ origin
            poses.append((rotation, origin))
        return poses


def inverse_dynamics(tree: Tree, q: Any, v: Any, a: Any) -> Any:
    """Torques [Nm or N] that give accelerations `a`: RNEA with armature and damping."""
    q, v, a = (tree.joints_by_axes @ value for value in (q, v, a))
    transforms: list[Any] = []
    velocity: list[Any] = []
    force: list[Any] = []
    acceleration: list[Any] = []
    for j in range(tree.count):
        s, x = ca.SX(tree.axis[j]), tree.transform(j, q[j])
        parent = tree.parent[j]
        v_parent = velocity[parent] if parent >= 0 else ca.SX(6, 1)
        a_parent = acceleration[parent] if parent >= 0 else ca.SX(-tree.gravity)
        velocity.append(x @ v_parent + s * v[j])
        acceleration.append(x @ a_parent + s * a[j] + _cross_motion(velocity[j]) @ (s * v[j]))
        inertia = ca.SX(tree.inertia[j])
        force.append(inertia @ acceleration[j] + _cross_force(velocity[j]) @ inertia @ velocity[j])
        transforms.append(x)
    tau: list[Any] = [None] * tree.count
    for j in reversed(range(tree.count)):
        tau[j] = ca.dot(ca.SX(tree.axis[j]), force[j])
        tau[j] += tree.armature[j] * a[j] + tree.damping[j] * v[j]
        if tree.parent[j] >= 0:
            force[tree.parent[j]] += transforms[j].T @ force[j]
    return tree.joints_by_axes.T @ ca.vertcat(*tau)


def kinetic_energy(tree: Tree, q: Any, v: Any) -> Any:
    """Of all bodies and armatures [J]: half of v times what takes it to accelerations v."""
    still = ca.SX.zeros(tree.count)
    momentum = inverse_dynamics(tree, q, still, v) - inverse_dynamics(tree, q, still, still)
    return ca.dot(v, momentum) / 2


def potential_energy(tree: Tree, q: Any) -> Any:
    """Of all bodies in gravity [J], zero with every centre of mass at the world's origin."""
    energy = ca.SX(0)
    bodies = zip(tree.poses(q), tree.mass, tree.lever, strict=True)
    for (rotation, origin), mass, lever in bodies:
        energy -= mass * ca.dot(ca.SX(tree.gravity[:3]), origin + rotation @ ca.SX(lever))
    return energy


def forward_dynamics(tree: Tree, q: Any, v: Any, tau: Any) -> Any:
    """Accelerations under torques `tau`: ABA with armature and damping."""
    n = tree.count
    q, v = tree.joints_by_axes @ q, tree.joints_by_axes @ v
    tau = tree.axes_by_joints.T @ tau
    transforms: list[Any] = []
    velocity: list[Any] = []
    bias_acceleration: list[Any] = []
    inertia: list[Any] = []
    bias: list[Any] = []
    for j in range(n):
        s, x = ca.SX(tree.axis[j]), tree.transform(j, q[j])
        v_parent = velocity[tree.parent[j]] if tree.parent[j] >= 0 else ca.SX(6, 1)
        velocity.append(x @ v_parent + s * v[j])
        bias_acceleration.append(_cross_motion(velocity[j]) @ (s * v[j]))
        inertia.append(ca.SX(tree.inertia[j]))
        bias.append(_cross_force(velocity[j]) @ inertia[j] @ velocity[j])
        transforms.append(x)
    force: list[Any] = [None] * n
    diagonal: list[Any] = [None] * n
    torque: list[Any] = [None] * n
    for j in reversed(range(n)):
        s = ca.SX(tree.axis[j])
        force[j] = inertia[j] @ s
        diagonal[j] = ca.dot(s, force[j]) + tree.armature[j]
        torque[j] = tau[j] - tree.damping[j] * v[j] - ca.dot(s, bias[j])
        parent = tree.parent[j]
        if parent >= 0:
            rank_one = force[j] @ force[j].T / diagonal[j]
            articulated = inertia[j] - rank_one
            articulated_bias = (
                bias[j] + articulated @ bias_acceleration[j] + force[j] * (torque[j] / diagonal[j])
            )
            inertia[parent] += transforms[j].T @ articulated @ transforms[j]
            bias[parent] += transforms[j].T @ articulated_bias
    result: list[Any] = []
    acceleration: list[Any] = []
    for j in range(n):
        parent = tree.parent[j]
        a_parent = acceleration[parent] if parent >= 0 else ca.SX(-tree.gravity)
        a = transforms[j] @ a_parent + bias_acceleration[j]
        result.append((torque[j] - ca.dot(force[j], a)) / diagonal[j])
        acceleration.append(a + ca.SX(tree.axis[j]) * result[j])
    return tree.axes_by_joints @ ca.vertcat(*result)


def forward_derivatives(tree: Tree, q: Any, v: Any, tau: Any) -> tuple[Any, Any, Any]:
    """Accelerations (n,) under torques `tau`, their Jacobian in [q, v] (n, 2n) and the
    inverse mass matrix (n, n), which is their Jacobian in tau.

    By the implicit function theorem on inverse dynamics ID(q, v, a) = tau, which is a third of the
    operations of differentiating the recursion of `forward_dynamics`: J. Carpentier, N. Mansard,
    Analytical Derivatives of Rigid Body Dynamics Algorithms, RSS 2018, section V.
    """
    n = tree.count
    free = ca.SX.sym("a", n)
    torque = inverse_dynamics(tree, q, v, free)
    mass = ca.jacobian(torque, free)
    root = ca.solve(ca.chol(mass), ca.SX.eye(n))
    inverse = root @ root.T
    bias = ca.substitute(torque, free, ca.SX.zeros(n))
    a = inverse @ (tau - bias)
    state = -inverse @ ca.substitute(ca.jacobian(torque, ca.vertcat(q, v)), free, a)
    return a, state, inverse
