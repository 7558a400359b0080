"""Launch the excitation node on a schedule; start it with its ~/start service or autostart.

`namespace:=left` for one of several aircraft; a `config:=` of your own is rooted at
`/left/excitation` then, or at `/**`.
"""

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """One node with the shipped parameters and the arguments on top."""
    config = Path(get_package_share_directory('quad_sysid')) / 'config' / 'excitation.yaml'
    shipped = yaml.safe_load(config.read_text(encoding='utf-8'))['excitation']['ros__parameters']
    defaults = {'schedule': 'schedule_rig', 'autostart': 'false', 'namespace': '',
                'config': str(config)}
    given = {name: LaunchConfiguration(name) for name in defaults}
    own = {'schedule': ParameterValue(given['schedule'], value_type=str),
           'autostart': ParameterValue(given['autostart'], value_type=bool)}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()),
        Node(package='quad_sysid', executable='excitation', name='excitation', output='screen',
             namespace=given['namespace'], parameters=[shipped, given['config'], own]),
    ])
