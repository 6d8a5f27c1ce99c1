"""What is read from a machine's file, MJCF or URDF, and the bounds of its dynamics."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headway.models.envelope import Envelope, envelope
from headway.models.machine import load_machine
from headway.models.margin import phase_margin_deg
from headway.models.source import read_spec
from headway.models.stated import stated

MACHINES = Path(__file__).resolve().parent / "machines"

MJCF = """
<mujoco>
  <compiler angle="{angle}" autolimits="true"/>
  <worldbody>
    <body name="a">
      <joint name="turn" axis="0 1 0" {turn}/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body name="b" pos="0.3 0 0">
        <joint name="shift" type="slide" axis="1 0 0" {shift}/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  {more}
</mujoco>
"""

URDF = """
<robot name="r">
  <link name="base"/>
  <link name="arm">
    <inertial>
      <origin xyz="0 0 0.1"/><mass value="1"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.002" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual><geometry><mesh filename="package://nowhere/arm.dae"/></geometry></visual>
    <collision><geometry><mesh filename="package://nowhere/arm.stl"/></geometry></collision>
    <collision><geometry><box size="0.1 0.1 0.2"/></geometry></collision>
  </link>
  <link name="hand">
    <inertial>
      <mass value="0.5"/>
      <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="swing" type="revolute">
    <parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="{velocity}"/>
    <dynamics damping="0.1" friction="0.02"/>
  </joint>
  <joint name="reach" type="prismatic">
    <parent link="arm"/><child link="hand"/><axis xyz="0 0 1"/>
    <origin xyz="0 0 0.3"/>
    <limit lower="0" upper="0.2" effort="30" velocity="0.5"/>{mimic}
  </joint>
</robot>
"""
LIMITS = {"lower": -1, "upper": 2, "effort": 12, "velocity": 3, "mimic": ""}


def mjcf(folder: Path, **parts: str) -> Path:
    path = folder / "machine.xml"
    path.write_text(
        MJCF.format(
            **{"angle": "radian", "turn": "", "shift": "", "actuators": "", "more": ""} | parts
        )
    )
    return path


def urdf(folder: Path, **parts: object) -> Path:
    path = folder / "machine.urdf"
    path.write_text(URDF.format(**LIMITS | parts))
    return path


motors = st.fixed_dictionaries(
    {
        "gear": st.floats(-50, 50).filter(lambda gear: abs(gear) > 0.1),
        "low": st.none() | st.floats(-5, -0.1),  # none: as far as the other way
        "high": st.floats(0.1, 5),
        "force": st.none() | st.floats(0.1, 20),
        "kind": st.sampled_from(["motor", "general", "position", "damper"]),
    }
)


def actuator(motor: dict[str, object]) -> str:
    force = "" if motor["force"] is None else f'forcerange="-{motor["force"]} {motor["force"]}"'
    low = -float(str(motor["high"])) if motor["low"] is None else motor["low"]
    control = f'ctrlrange="{low} {motor["high"]}"'
    kind = {
        "motor": "motor",
        "general": 'general gainprm="2.5"',
        "position": 'position kp="1000"',
        "damper": 'velocity kv="1000"',
    }[str(motor["kind"])]
    return f'<{kind} joint="turn" gear="{motor["gear"]}" {control} {force}/>'


@settings(max_examples=100, deadline=None)
@given(given_motors=st.lists(motors, max_size=3), joint=st.none() | st.floats(0.5, 100))
def test_stated_effort_is_what_mujoco_saturates_at(
    tmp_path_factory: pytest.TempPathFactory,
    given_motors: list[dict[str, object]],
    joint: float | None,
) -> None:
    """The oracle: MuJoCo's own force on the joint with all controls far beyond their ranges."""
    own = "" if joint is None else f'actuatorfrcrange="-{joint} {joint}"'
    text = "".join(actuator(motor) for motor in given_motors)
    path = mjcf(tmp_path_factory.mktemp("mjcf"), turn=own, actuators=text)
    (turn, shift) = stated(path, ("turn", "shift"))
    assert shift.effort is None
    open_ended = [m for m in given_motors if m["kind"] in ("position", "damper") and not m["force"]]
    if joint is None and (open_ended or not given_motors):
        assert turn.effort is None  # such a force grows with the error
        return
    assert turn.effort is not None
    model = mujoco.MjModel.from_xml_path(str(path))
    data, forces = mujoco.MjData(model), []
    for sign in (1, -1):
        data.ctrl[:] = sign * 1e9 * np.sign(model.actuator_gear[:, 0])
        mujoco.mj_forward(model, data)
        forces.append(abs(data.qfrc_actuator[0]))
    if open_ended:
        assert turn.effort == joint
    elif given_motors:  # each of them counts with the weaker of its directions
        assert turn.effort <= min(forces) * (1 + 1e-9)
        if all(motor["low"] is None for motor in given_motors):
            assert turn.effort == pytest.approx(min(forces), rel=1e-9)
    else:
        assert turn.effort == joint


def test_stated_ranges_of_hinge_and_slide_in_degrees(tmp_path: Path) -> None:
    """An angle unit of degrees is none of a slide's business."""
    path = mjcf(tmp_path, angle="degree", turn='range="-90 180"', shift='range="-0.1 0.2"')
    turn, shift = stated(path, ("turn", "shift"))
    assert turn.position == pytest.approx((-np.pi / 2, np.pi))
    assert shift.position == pytest.approx((-0.1, 0.2))
    assert (turn.linear, shift.linear) == (False, True)
    assert (turn.velocity, turn.effort, turn.coulomb) == (None, None, 0.0)


def test_stated_of_a_urdf(tmp_path: Path) -> None:
    swing, reach = stated(urdf(tmp_path), ("swing", "reach"))
    assert swing.position == (-1.0, 2.0)
    assert (swing.velocity, swing.effort, swing.coulomb) == (3.0, 12.0, 0.02)
    assert (reach.position, reach.velocity, reach.effort) == ((0.0, 0.2), 0.5, 30.0)


def test_limits_that_nobody_filled_in_are_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = urdf(tmp_path, lower=0, upper=0, effort=0, velocity=0)
    swing, _ = stated(path, ("swing", "reach"))
    assert (swing.position, swing.velocity, swing.effort) == (None, None, None)
    assert [p.name for p in tmp_path.iterdir()] == ["machine.urdf"]  # MuJoCo had nothing to log


def test_a_urdfs_meshes_are_left_out(tmp_path: Path) -> None:
    model = read_spec(urdf(tmp_path)).compile()
    assert model.nmesh == 0
    assert [model.geom_type[i] for i in range(model.ngeom)] == [mujoco.mjtGeom.mjGEOM_BOX]
    assert load_machine(tmp_path / "machine.urdf").joints == ("swing", "reach")


def test_branches_may_come_in_another_order(tmp_path: Path) -> None:
    """pinocchio goes through a URDF's branches by name, MuJoCo as they stand."""
    link = (
        '<link name="{n}"><inertial><origin xyz="{x} 0 0"/><mass value="{x}"/>'
        '<inertia ixx="{x}" iyy="{x}" izz="{x}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="j{n}" type="revolute"><parent link="base"/><child link="{n}"/>'
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    text = "".join(link.format(n=n, x=x) for n, x in (("z", 1), ("m", 2), ("a", 3)))
    path = tmp_path / "tree.urdf"
    path.write_text(f'<robot name="t"><link name="base"/>{text}</robot>')
    machine = load_machine(path)
    model = read_spec(path).compile()
    assert sorted(machine.joints) == ["ja", "jm", "jz"]
    assert [j.name for j in stated(path, machine.joints)] == list(machine.joints)
    assert list(machine.joints) != [model.joint(j).name for j in range(3)]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"turn": 'stiffness="3"'}, "springs"),
        ({"more": '<equality><joint joint1="turn" joint2="shift"/></equality>'}, "equality"),
        ({"shift": 'range="0 1" ball="x"'}, "XML"),
    ],
)
def test_an_mjcf_that_cannot_be_controlled(
    tmp_path: Path, parts: dict[str, str], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        load_machine(mjcf(tmp_path, **parts))
    assert "machine.xml" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("", "", None),
        ('type="revolute"', 'type="floating"', "swing: only hinge and slide"),
        (
            '"0.2" effort="30" velocity="0.5"/>',
            '"1" effort="1" velocity="1"/><mimic joint="swing"/>',
            "mimic",
        ),
        ('izz="0.002"', 'izz="-1"', "inertia"),
        ('<link name="base"/>', "<link", "XML|urdf"),
    ],
)
def test_a_urdf_that_cannot_be_controlled(
    tmp_path: Path, old: str, new: str, message: str | None
) -> None:
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace(old, new) if old else path.read_text())
    if message is None:
        load_machine(path)
        return
    with pytest.raises(ValueError, match=message) as caught:
        load_machine(path)
    assert "machine.urdf" in str(caught.value)


# The envelope holds over the whole range, not only where it was sampled.


@pytest.fixture(scope="module")
def planar3() -> tuple[Envelope, mujoco.MjModel]:
    path = MACHINES / "planar3.xml"
    model = read_spec(path).compile()
    return envelope(load_machine(path), *model.jnt_range.T), model


def pose(model: mujoco.MjModel, shares: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Mass matrix and gravity's effort by MuJoCo, at shares of the range."""
    data = mujoco.MjData(model)
    low, high = model.jnt_range.T
    data.qpos[:] = low + np.array(shares) * (high - low)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return mass, data.qfrc_bias.copy()


shares = st.lists(st.floats(0, 1), min_size=3, max_size=3)


@settings(max_examples=300, deadline=None)
@given(at=shares)
def test_no_pose_is_outside_of_the_envelope(
    planar3: tuple[Envelope, mujoco.MjModel], at: list[float]
) -> None:
    reach, model = planar3
    mass, gravity = pose(model, at)
    assert np.all(np.diag(mass) <= 1.02 * reach.inertia_max)
    assert np.all(1 / np.diag(np.linalg.inv(mass)) >= 0.98 * reach.inertia_min)
    assert np.all(np.abs(gravity) <= 1.02 * reach.holding_max + 1e-9)


@settings(max_examples=300, deadline=None)
@given(at=shares, damping=st.lists(st.floats(0.01, 100), min_size=3, max_size=3))
def test_no_pose_decays_faster(
    planar3: tuple[Envelope, mujoco.MjModel], at: list[float], damping: list[float]
) -> None:
    """The oracle: the eigenvalues of v' = -M^-1 D v."""
    reach, model = planar3
    mass, _ = pose(model, at)
    rates = np.linalg.eigvals(np.linalg.inv(mass) @ np.diag(damping)).real
    fastest, share = reach.fastest(np.array(damping))
    assert rates.max() <= 1.02 * fastest
    assert share.sum() == pytest.approx(1) and np.all(share >= 0)


def test_the_bounds_are_reached(planar3: tuple[Envelope, mujoco.MjModel]) -> None:
    reach, model = planar3
    stretched, _ = pose(model, [0.5, 0.5, 0.5])
    np.testing.assert_allclose(np.diag(stretched), reach.inertia_max, rtol=0.02)
    _, gravity = pose(model, [60 / 210, 0.5, 0.5])
    np.testing.assert_allclose(np.abs(gravity), reach.holding_max, rtol=0.02)
    damping = np.array([1.0, 0.0, 0.0])
    assert reach.fastest(damping)[0] == pytest.approx(1 / reach.inertia_min[0], rel=1e-6)


@pytest.mark.parametrize("kp", [1.0, 20.0, 400.0])
def test_gravity_topples_an_upright_pendulum(tmp_path: Path, kp: float) -> None:
    """Upright, a spring of m g l is just what holds a point mass of m at l."""
    path = tmp_path / "pendulum.xml"
    path.write_text(
        '<mujoco><worldbody><body name="b"><joint name="j" axis="0 1 0" range="-40 40"/>'
        '<inertial pos="0 0 0.5" mass="2" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody>'
        "</mujoco>"
    )
    reach = envelope(load_machine(path), np.array([-0.7]), np.array([0.7]))
    toppled, share = reach.toppling(np.array([kp]))
    assert toppled == pytest.approx(2 * 9.81 * 0.5 / kp, rel=1e-6)
    assert share.tolist() == [1.0]


# The phase margin against the exact sampled loop: difference over one period, effort held.


def spectral_radius(kp: float, kd: float, inertia: float, period: float) -> float:
    """Of [x, v, x before] from sample to sample."""
    a = np.array([[1, period], [0, 1]])
    b = np.array([period**2 / 2, period]) / inertia
    gain = -np.array([kp + kd / period, 0, -kd / period])
    closed = np.zeros((3, 3))
    closed[:2, :2], closed[2, 0] = a, 1
    closed[:2] += np.outer(b, gain)
    return float(np.abs(np.linalg.eigvals(closed)).max())


@settings(max_examples=500, deadline=None)
@given(
    wn=st.floats(2, 300),
    zeta=st.floats(0.02, 5),
    inertia=st.floats(1e-5, 1e4),
    period=st.floats(1e-4, 5e-3),
)
def test_phase_margin_tells_stability(
    wn: float, zeta: float, inertia: float, period: float
) -> None:
    kp, kd = wn**2 * inertia, 2 * zeta * wn * inertia
    margin = phase_margin_deg(kp, kd, 0.0, inertia, period)
    radius = spectral_radius(kp, kd, inertia, period)
    if margin > 20:
        assert radius < 1
    if margin < -30:
        assert radius > 1


def test_phase_margin_of_a_double_integrator() -> None:
    """Closed form without lag: with wn = 1, gain one at w^2 = 2 z^2 + sqrt(4 z^4 + 1)."""
    for zeta in (0.1, 0.5, 1.0, 2.0):
        w = np.sqrt(2 * zeta**2 + np.sqrt(4 * zeta**4 + 1))
        expected = np.degrees(np.arctan(2 * zeta * w))
        assert phase_margin_deg(1.0, 2 * zeta, 0.0, 1.0, 0.0) == pytest.approx(expected, abs=0.2)
    assert phase_margin_deg(0.0, 0.0, 0.0, 1.0, 1e-3) == 180.0
    assert phase_margin_deg(1.0, 0.0, 1.0, 1.0, 0.0) < 0  # integral without damping
