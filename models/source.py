"""A machine's file, MJCF or URDF, as MuJoCo and pinocchio read it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import pinocchio as pin

OPEN = 1e9  # rad or m: where a URDF's limits are of no width, as exporters write them, or none


def is_urdf(path: Path) -> bool:
    """By the file's name: MJCF ends in .xml, URDF in .urdf."""
    return path.suffix.lower() == ".urdf"


def read_spec(path: Path) -> mujoco.MjSpec:
    """Reads a file for MuJoCo; `compile()` makes a model of it.

    Of a URDF's shapes only boxes, spheres and cylinders remain, for contacts. Meshes are left out:
    motion needs the links' inertias alone, and mesh files are often elsewhere (package://) or in
    formats that MuJoCo does not read. Limits of no width are opened. Raises ValueError for a file
    that cannot be read.
    """
    if not is_urdf(path):
        return mujoco.MjSpec.from_file(str(path))
    robot = _robot(path)
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for collision in link.findall("collision"):
            if collision.find("geometry/mesh") is not None:
                link.remove(collision)
    for limit in robot.iter("limit"):
        if float(limit.get("lower", "0")) >= float(limit.get("upper", "0")):
            limit.set("lower", str(-OPEN))  # MuJoCo would warn, in a file of its own
            limit.set("upper", str(OPEN))
    return mujoco.MjSpec.from_string(ET.tostring(robot, encoding="unicode"))


def read_model(path: Path) -> pin.Model:
    """Reads a file for pinocchio.

    A URDF's continuous joints become revolute ones: pinocchio would have their cosine and sine for
    coordinates, where all others have an angle. Raises ValueError for a file that cannot be read.
    """
    if not is_urdf(path):
        return pin.buildModelFromMJCF(str(path))
    robot = _robot(path)
    for joint in _continuous(robot):
        joint.set("type", "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = ET.SubElement(joint, "limit", effort="0", velocity="0")
        limit.set("lower", str(-OPEN))
        limit.set("upper", str(OPEN))
    return pin.buildModelFromXML(ET.tostring(robot, encoding="unicode"))


def continuous_joints(path: Path) -> set[str]:
    """Joints of which the file says that they turn for ever: an MJCF says it of none, since a hinge
    without a range may be one that nobody has measured."""
    if not is_urdf(path):
        return set()
    return {joint.get("name", "") for joint in _continuous(_robot(path))}


def _robot(path: Path) -> ET.Element:
    """A URDF's root. Raises ValueError."""
    try:
        return ET.parse(path).getroot()
    except ET.ParseError as error:
        raise ValueError(f"XML: {error}") from error


def _continuous(robot: ET.Element) -> list[ET.Element]:
    return [joint for joint in robot.iter("joint") if joint.get("type") == "continuous"]
