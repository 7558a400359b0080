"""A craft by its description, its autopilot's parameters, its layout's name; and its mixer."""

import numpy as np
import pytest

from quad_bridge.craft import (
    LAYOUTS,
    Craft,
    Motor,
    X,
    ardupilot_channels,
    from_urdf,
    of_ardupilot,
    of_betaflight,
    of_px4,
)


@pytest.mark.parametrize('name', LAYOUTS)
def test_every_layout_comes_back_from_its_urdf_and_turns_each_axis(name):
    craft = LAYOUTS[name]
    again = from_urdf(craft.to_urdf())
    np.testing.assert_allclose(again.inverse, craft.inverse, atol=1e-6)
    np.testing.assert_allclose(craft.inverse @ craft.mixer, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(np.abs(craft.inverse).sum(axis=1), 1.0)
    assert sum(m.spin for m in craft.motors) == 0


def test_autopilots_of_one_frame_describe_the_same_craft():
    px4 = {'CA_ROTOR_COUNT': 4.0}
    for i, (x, right, km) in enumerate(((0.15, 0.25, 0.05), (-0.15, -0.19, 0.05),
                                        (0.15, -0.25, -0.05), (-0.15, 0.19, -0.05))):
        px4 |= {f'CA_ROTOR{i}_PX': x, f'CA_ROTOR{i}_PY': right, f'CA_ROTOR{i}_KM': km}
    described = of_px4(px4)
    assert described.motors[1] == Motor(-0.15, 0.19, 1, 0.0)
    assert not described.nominal
    same = of_ardupilot({'FRAME_CLASS': 1.0, 'FRAME_TYPE': 1.0})
    assert described.signs == same.signs == LAYOUTS['px4_quad_x'].signs
    inwards, outwards = of_betaflight({}), of_betaflight({'mixer': 3, 'yaw_motors_reversed': '1'})
    assert inwards.signs == of_ardupilot({'FRAME_TYPE': 12.0}).signs
    assert outwards.signs == of_ardupilot({'FRAME_TYPE': 18.0}).signs
    assert [-a[2] for a in inwards.signs] == [b[2] for b in outwards.signs]
    assert of_betaflight({'mixer': 'HEX6X'}).count == 6
    assert of_ardupilot({'FRAME_CLASS': 5.0, 'FRAME_TYPE': 1.0}).name == "ArduPilot's y6"
    hexa = {f'SERVO{k}_FUNCTION': 39.0 - k for k in range(1, 7)}  # of a frame that is not known
    assert ardupilot_channels(hexa) == (6, 5, 4, 3, 2, 1)
    assert ardupilot_channels({}) == (1, 2, 3, 4)
    for why, part in (
        (of_px4({}), 'CA_ROTOR_COUNT'), (of_px4(px4 | {'CA_ROTOR2_KM': 0.0}), 'rotor 3'),
        (of_ardupilot({'FRAME_CLASS': 7.0}), 'FRAME_CLASS 7'),
        (of_betaflight({'mixer': 1}), 'TRI'),
    ):
        assert part in why


ARM = """<robot name="drawn"><link name="root"/><link name="base_link"><inertial>
<mass value="1.5"/><inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial>
</link><joint name="stand" type="fixed"><parent link="root"/><child link="base_link"/>
<origin xyz="0 0 7"/></joint>{}</robot>"""
MOUNTED = """<joint name="arm_{k}" type="fixed"><parent link="base_link"/><child link="arm_{k}"/>
<origin xyz="0 0 0.1" rpy="0 0 {yaw}"/></joint><joint name="motor_{k}" type="continuous">
<parent link="arm_{k}"/><child link="propeller_{k}"/><origin xyz="0.3 0 0" rpy="{rpy}"/>
<axis xyz="0 0 1"/></joint>"""


def test_a_urdf_may_mount_its_motors_on_arms_and_upside_down():
    joints = ''.join(MOUNTED.format(k=k, yaw=np.pi / 2 * k, rpy='0 0 0' if k % 2 else
                                    '3.14159265 0 0') for k in range(1, 5))
    craft = from_urdf(ARM.format(joints.replace('motor_3', 'motor_03')))
    assert craft.places == ('left', 'rear', 'right', 'front')
    assert [m.spin for m in craft.motors] == [1, -1, 1, -1]
    assert craft.motors[0].z == pytest.approx(0.1)
    assert (craft.mass_kg, craft.inertia) == (1.5, (0.02, 0.03, 0.04))
    assert from_urdf(Craft('x', X.motors, 1.5, craft.inertia).to_urdf()).mass_kg == 1.5


def test_a_model_for_drawing_is_none_and_a_broken_one_says_where():
    assert from_urdf(ARM.format('')) is None
    one = MOUNTED.format(k=2, yaw=0, rpy='0 0 0')
    for text, says in (
        ('<robot', 'no XML'), (ARM.format(one), 'joints motor_2'),
        (ARM.format(one.replace('motor_2', 'motor_1').replace('"0.3 0 0"', '"0.3 0"')), 'motor_1'),
        (ARM.format(one.replace('motor_2', 'motor_1').replace('0 0 1"/>', '0 1 0"/>')), 'lifts'),
        (ARM.format(one.replace('motor_2', 'motor_1').replace('continuous', 'revolute')), 'type'),
    ):
        with pytest.raises(ValueError, match=says):
            from_urdf(text)


def test_the_clip_is_of_the_crafts_own_mixer():
    hexa = LAYOUTS['betaflight_hex6x']
    control = np.array([[0.5, 0.1, -0.05, 0.02], [0.5, 0.9, 0.0, 0.0]])
    motors = hexa.commands(control)
    np.testing.assert_allclose(hexa.control(motors)[0], control[0], atol=1e-9)
    assert motors.min() == 0.0
    assert motors.max() == 1.0
    assert hexa.control(motors)[1, 1] < 0.9
